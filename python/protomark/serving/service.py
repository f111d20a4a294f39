"""The web service: what each address answers."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import cache, partial
from importlib.resources import files
from typing import Annotated, Any

from fastapi import FastAPI, Request, Response
from fastapi import Query as UrlQuery
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse
from fastapi_offline import FastAPIOffline
from pydantic.json_schema import models_json_schema
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from protomark import __version__
from protomark.localization.localizer import Localizer
from protomark.serving.answers import answer_of
from protomark.serving.messages import Answer, FeaturesMessage, Health, Problem, Settings
from protomark.serving.metrics import CONTENT_TYPE, Metrics, Observed
from protomark.serving.reading import Limits, Refusal, drain, receive_upload, sentence_of
from protomark.serving.workers import Gone, Workers

TopView = Callable[[], list[dict[str, Any]]]
# The page is one file, and asks nobody but this server.
_PAGE_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src blob: data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
_DESCRIPTION = """Finds where images were taken in a map.

Poses are `cam_from_world` in COLMAP's conventions: quaternions are w, x, y, z, pixels begin at the
upper left corner of the image, and y points down."""
_BINARY = {"type": "string", "format": "binary"}


def make_app(localizer: Localizer, limits: Limits, view: TopView) -> FastAPI:
    """The service of a map.

    Args:
        localizer: finds poses.
        limits: what the server takes.
        view: makes the picture of the map for the page, see `top_view`.
    """
    workers = Workers(limits)
    descriptor = localizer.scene.encoder.descriptor
    figures = Metrics(workers, lambda: len(localizer.scene))
    app = FastAPIOffline(
        title="Protomark", version=__version__, description=_DESCRIPTION, redoc_url=None
    )
    app.state.workers = workers
    problems: dict[int | str, dict[str, Any]] = {
        code: {"model": Problem, "description": text}
        for code, text in {
            408: "The body arrived too slowly.",
            413: "The body or the image is too large, or there are too many keypoints.",
            422: "The request cannot be understood, or does not fit the map.",
            503: "The server is busy: try again after as many seconds as Retry-After says.",
            504: "The answer took too long.",
        }.items()
    }

    async def answer(request: Request, settings: Settings) -> Answer:
        deadline = time.monotonic() + limits.seconds
        try:
            with workers.slot():
                upload = await receive_upload(request, settings, limits)
                work = partial(answer_of, localizer, upload, limits)
                return await workers.run(work, request, deadline)
        except Refusal:
            await drain(request)
            raise

    @app.post(
        "/localize",
        response_model=Answer,
        responses=problems,
        openapi_extra={"requestBody": _request_body()},
    )
    async def localize(request: Request, settings: Annotated[Settings, UrlQuery()]) -> Response:
        """Find the pose of an image, or of keypoints with their descriptors.

        A body that is neither JSON nor a form is an image or a safetensors file, whatever its
        content type. An answer without a pose has a reason.
        """
        answered = await answer(request, settings)
        figures.answered(answered)
        unlikely = "no pose" if answered.cam_from_world is None else "unlikely pose"
        request.state.outcome = "pose" if answered.accepted else unlikely
        return Response(answered.model_dump_json(), media_type="application/json")

    @app.get("/health")
    async def health() -> Health:
        """Say that the map is open and requests are taken."""
        return Health(
            status="ok",
            version=__version__,
            landmarks=len(localizer.scene),
            descriptor=descriptor,
            in_progress=workers.in_progress,
            waiting=workers.waiting,
        )

    @app.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
    async def prometheus() -> Response:
        """Figures for Prometheus."""
        return Response(figures.text(), media_type=CONTENT_TYPE)

    once, seen = threading.Lock(), cache(view)

    @app.get("/map", include_in_schema=False)
    def picture() -> JSONResponse:
        with once:
            places = seen()
        return JSONResponse({"landmarks": len(localizer.scene), "places": places})

    @app.get("/", include_in_schema=False)
    async def page() -> HTMLResponse:
        text = files("protomark.serving").joinpath("page.html").read_text("utf-8")
        return HTMLResponse(text, headers={"Content-Security-Policy": _PAGE_POLICY})

    _describe_features(app)
    _answer_errors(app)
    app.add_middleware(Observed, figures=figures, failed=_failed)
    return app


def _answer_errors(app: FastAPI) -> None:
    @app.exception_handler(Refusal)
    async def refused(request: Request, error: Refusal) -> Response:
        return _problem(error.status, str(error), error.headers)

    @app.exception_handler(RequestValidationError)
    async def invalid(request: Request, error: RequestValidationError) -> Response:
        await drain(request)
        return _problem(422, sentence_of(error.errors()))

    @app.exception_handler(HTTPException)
    async def unknown(request: Request, error: HTTPException) -> Response:
        if error.status_code == 404:
            return _problem(404, "there is nothing at this address: /docs lists what there is")
        if error.status_code == 405:
            allowed = (error.headers or {}).get("Allow", "")
            return _problem(405, f"this address takes only {allowed}: see /docs", error.headers)
        return _problem(error.status_code, str(error.detail))

    async def hung_up(request: Request, error: Exception) -> Response:
        request.state.outcome = "gone"
        return _problem(499, "the client hung up")

    app.add_exception_handler(Gone, hung_up)
    app.add_exception_handler(ClientDisconnect, hung_up)


async def _failed(scope: Any, receive: Any, send: Any) -> None:
    problem = _problem(500, "the server failed at this request, and its log says where")
    await problem(scope, receive, send)


def _problem(status: int, sentence: str, headers: Any = None) -> Response:
    return JSONResponse({"detail": sentence}, status, headers)


def _request_body() -> dict[str, Any]:
    texts = Settings.model_json_schema()["properties"]
    form = {"image": _BINARY, "features": _BINARY, **texts}
    return {
        "required": True,
        "content": {
            "multipart/form-data": {"schema": {"type": "object", "properties": form}},
            "image/*": {"schema": _BINARY},
            "application/octet-stream": {
                "schema": {
                    **_BINARY,
                    "description": "safetensors: keypoints (n, 2) float32 or float64, descriptors "
                    "(n, bytes) uint8; or an image",
                }
            },
            "application/json": {
                "schema": {"$ref": f"#/components/schemas/{FeaturesMessage.__name__}"}
            },
        },
    }


def _describe_features(app: FastAPI) -> None:
    """Add the schema of bodies, which the service reads itself, to the OpenAPI page."""
    make = app.openapi

    @cache
    def openapi() -> dict[str, Any]:
        _, schemas = models_json_schema(
            [(FeaturesMessage, "validation")], ref_template="#/components/schemas/{model}"
        )
        described = make()
        described["components"]["schemas"].update(schemas["$defs"])
        return described

    app.openapi = openapi  # type: ignore[method-assign]
