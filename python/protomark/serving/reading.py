"""Reads requests: limits their bodies, and finds images, features, cameras and priors in them."""

from __future__ import annotations

import asyncio
import binascii
import io
import os
from base64 import b64decode
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.requests import Request

from protomark.extras import optional
from protomark.features.images import decode_gray
from protomark.geometry.absolute_pose import FocalLength
from protomark.geometry.camera import CAMERA_EXAMPLE, Camera
from protomark.geometry.pose import rotation_from_quaternion
from protomark.localization.prior import PosePrior
from protomark.serving.messages import CameraMessage, FeaturesMessage, Settings

Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]

IMAGE_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "PPM")
# More take seconds to search; the extractor keeps 2,000.
MAX_KEYPOINTS = 10_000
# How long what a client sends is thrown away before it gets an answer that it does not wait for.
_DRAIN_SECONDS = 5.0


class Refusal(Exception):  # noqa: N818 - an answer
    """An answer other than a pose: its status, and a sentence."""

    def __init__(self, status: int, sentence: str, retry_after: int | None = None) -> None:
        super().__init__(sentence)
        self.status = status
        self.headers = {} if retry_after is None else {"Retry-After": str(retry_after)}


@dataclass(frozen=True)
class Limits:
    """What a server takes at most."""

    megabytes: float = 20.0  # of a body, 10^6 bytes
    megapixels: float = 50.0  # of an image, 10^6 pixels
    seconds: float = 30.0  # from the first byte of a request to its answer
    threads: int = 1  # requests that are computed at a time
    waiting: int = 32  # requests that wait for a thread


@dataclass(frozen=True)
class Upload:
    """A request as it came: the bytes of an image or of features, and what was said about them."""

    data: bytes
    settings: Settings
    is_json: bool = False


@dataclass(frozen=True)
class FrameRequest:
    """What to localize: an image, or keypoints and descriptors."""

    camera: Camera | None
    prior: PosePrior | None
    focal_length: FocalLength
    details: bool
    image: NDArray[np.uint8] | None = None  # (height, width)
    exif: Callable[[], Camera | None] = lambda: None  # the camera that the image's EXIF data tell
    keypoints: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))  # (n, 2)
    # (n, bits / 8)
    descriptors: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 0), np.uint8))


async def receive_upload(request: Request, settings: Settings, limits: Limits) -> Upload:
    """Read the body of a request, and hold no more of it than the limit.

    Raises:
        Refusal: it is too large, too slow, empty, or a form that is none.
    """
    limit = int(1e6 * limits.megabytes)
    declared = request.headers.get("content-length", "")
    if declared.isdecimal() and int(declared) > limit:
        raise _too_large(limits)
    limited = Request(request.scope, _limited(request.receive, limits, limit))
    try:
        upload = await asyncio.wait_for(_read(limited, settings), limits.seconds)
    except asyncio.TimeoutError:
        raise Refusal(
            408,
            f"the body did not arrive within {limits.seconds:g} s: send less, or over a faster "
            "connection",
        ) from None
    if not upload.data:
        raise Refusal(422, "the body is empty: send an image, or keypoints and descriptors")
    return upload


async def drain(request: Request) -> None:
    """Throw away what a client still sends: many read no answer before they have sent all."""
    if request.headers.get("expect", "").lower() == "100-continue":
        return  # it asked first

    async def receive() -> None:
        while not getattr(request.state, "received", False):
            await request.receive()

    with suppress(asyncio.TimeoutError):
        await asyncio.wait_for(receive(), _DRAIN_SECONDS)


def _too_large(limits: Limits) -> Refusal:
    return Refusal(
        413, f"the body is larger than {limits.megabytes:g} MB: send a smaller image, or features"
    )


def _limited(receive: Receive, limits: Limits, limit: int) -> Receive:
    received = 0

    async def limited() -> MutableMapping[str, Any]:
        nonlocal received
        message = await receive()
        received += len(message.get("body", b""))
        if received > limit:
            raise _too_large(limits)
        return message

    return limited


async def _read(request: Request, settings: Settings) -> Upload:
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "multipart/form-data":
        return Upload(await request.body(), settings, kind == "application/json")
    optional("python_multipart")
    try:
        async with request.form(max_files=1, max_fields=len(Settings.model_fields)) as form:
            files = {name: part for name, part in form.items() if isinstance(part, UploadFile)}
            texts = {name: part for name, part in form.items() if isinstance(part, str)}
            if not files.keys() <= {"image", "features"} or not files:
                raise Refusal(422, "the form has no file: name one `image`, or `features`")
            data = await next(iter(files.values())).read()
    except HTTPException as error:
        raise Refusal(422, f"the form cannot be read: {error.detail}") from None
    given = settings.model_dump(exclude_unset=True)
    if twice := given.keys() & texts.keys():
        raise Refusal(422, f"{min(twice)} is given twice, in the URL and in the form")
    return Upload(data, validated(lambda: Settings.model_validate({**given, **texts})))


def validated(make: Callable[[], Any]) -> Any:
    """What `make` returns; the first error of pydantic as a sentence."""
    try:
        return make()
    except ValidationError as error:
        raise Refusal(422, sentence_of(error.errors())) from None


def sentence_of(errors: Any) -> str:
    """The first of pydantic's errors as a sentence."""
    first = errors[0]
    places = (str(part) for part in first["loc"] if part not in ("query", "body"))
    where = ".".join(places)[:80] or "the JSON body"
    return f"{where}: {first['msg'][0].lower()}{first['msg'][1:]}: see /docs for what requests hold"


def parse(upload: Upload, limits: Limits, descriptor_bytes: int) -> FrameRequest:
    """What a request asks for.

    Args:
        upload: the request.
        limits: what the server takes.
        descriptor_bytes: bytes of a descriptor of the map's encoder.

    Raises:
        Refusal: the request asks for nothing, or for more than the limits allow.
    """
    try:
        if upload.is_json:
            return _parse_json(upload, descriptor_bytes)
        settings = upload.settings
        camera = Camera.parse(settings.camera) if settings.camera is not None else None
        prior = None
        if settings.prior is not None:
            prior = _prior(_numbers(settings.prior), settings.prior_distance, settings)
        asked = FrameRequest(camera, prior, settings.focal_length, settings.details)
        if _is_safetensors(upload.data):
            return _with_features(asked, *_load_safetensors(upload.data), descriptor_bytes)
        check_pixels(upload.data, limits)
        image = decode_gray(np.frombuffer(upload.data, np.uint8), "the image")
        return replace(asked, image=image, exif=lambda: _camera_from_exif(upload.data))
    except ValueError as error:
        raise Refusal(422, str(error)) from None


def _parse_json(upload: Upload, descriptor_bytes: int) -> FrameRequest:
    given = upload.settings.model_fields_set
    if given:
        raise ValueError(f"{min(given)} is in the URL, but the body is JSON: put it there")
    message = validated(lambda: FeaturesMessage.model_validate_json(upload.data))
    camera = message.camera
    if isinstance(camera, CameraMessage):
        camera = Camera(camera.model, camera.width, camera.height, tuple(camera.params))
        camera.check()
    elif camera is not None:
        camera = Camera.parse(camera)
    prior = None
    if message.prior is not None:
        numbers = np.array([*message.prior.quaternion, *message.prior.translation])
        prior = _prior(numbers, message.prior_distance, message)
    try:
        descriptors = np.frombuffer(b64decode(message.descriptors, validate=True), np.uint8)
    except binascii.Error as error:
        raise ValueError(f"descriptors: this is no base64 ({error})") from None
    keypoints = np.array(message.keypoints, np.float64).reshape(-1, 2)
    if descriptors.size != len(keypoints) * descriptor_bytes:
        raise ValueError(
            f"descriptors: {descriptors.size} bytes are not {descriptor_bytes} for each of "
            f"{len(keypoints)} keypoints, as the map's encoder takes them"
        )
    asked = FrameRequest(camera, prior, message.focal_length, message.details)
    rows = descriptors.reshape(-1, descriptor_bytes)
    return _with_features(asked, keypoints, rows, descriptor_bytes)


def _numbers(text: str) -> NDArray[np.float64]:
    try:
        return np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        return np.zeros(0)


def _prior(numbers: NDArray[np.float64], distance: float, settings: Any) -> PosePrior:
    if numbers.shape != (7,) or not np.isfinite(numbers).all():
        raise ValueError("prior: write a pose as QW QX QY QZ TX TY TZ, as in COLMAP's images.txt")
    pose = np.column_stack([rotation_from_quaternion(numbers[:4]), numbers[4:]])
    return PosePrior(pose, distance, settings.prior_degrees)


def _is_safetensors(data: bytes) -> bool:
    """Whether bytes begin as a safetensors file: the length of a header, and its brace."""
    return data[8:9] == b"{" and int.from_bytes(data[:8], "little") < len(data)


def _load_safetensors(data: bytes) -> tuple[NDArray[Any], NDArray[Any]]:
    load = optional("safetensors.numpy").load
    try:
        tensors: Mapping[str, NDArray[Any]] = load(data)
    except Exception as error:  # of several kinds, as of types that NumPy lacks
        raise ValueError(f"the features are no safetensors file: {error}") from None
    if tensors.keys() != {"keypoints", "descriptors"}:
        names = ", ".join(sorted(tensors))[:80] or "none"
        raise ValueError(f"the features hold {names}: name two tensors keypoints and descriptors")
    return tensors["keypoints"], tensors["descriptors"]


def _with_features(
    asked: FrameRequest, keypoints: NDArray[Any], descriptors: NDArray[Any], descriptor_bytes: int
) -> FrameRequest:
    if keypoints.ndim != 2 or keypoints.shape[1] != 2 or keypoints.dtype.kind != "f":
        raise ValueError(
            f"keypoints: {keypoints.shape} {keypoints.dtype} is not (n, 2) of a float type"
        )
    if descriptors.shape != (len(keypoints), descriptor_bytes) or descriptors.dtype != np.uint8:
        raise ValueError(
            f"descriptors: {descriptors.shape} {descriptors.dtype} is not ({len(keypoints)}, "
            f"{descriptor_bytes}) uint8, a row per keypoint as the map's encoder takes it"
        )
    if len(keypoints) > MAX_KEYPOINTS:
        raise Refusal(
            413, f"{len(keypoints)} keypoints are more than {MAX_KEYPOINTS}: send the strongest"
        )
    if not np.isfinite(keypoints).all():
        raise ValueError("keypoints: some are not finite numbers")
    if asked.camera is not None and not asked.camera.width:
        raise ValueError(
            f"camera {asked.camera.model} has no size, which features need: write MODEL WIDTH "
            "HEIGHT PARAMETERS"
        )
    return replace(asked, keypoints=keypoints.astype(np.float64), descriptors=descriptors)


def check_pixels(data: bytes, limits: Limits) -> None:
    """Refuse an image of too many pixels before it is decoded, and what is no image.

    Raises:
        ValueError: it has no format of `IMAGE_FORMATS`.
        Refusal: it is too large.
    """
    image = optional("PIL.Image")
    image.MAX_IMAGE_PIXELS = None  # the limit is ours
    try:
        with image.open(io.BytesIO(data), formats=IMAGE_FORMATS) as header:
            width, height = header.size
    except Exception:  # Pillow raises what its readers stumble on
        raise ValueError(
            f"the body is no image of a known format ({', '.join(IMAGE_FORMATS)}), and no "
            "safetensors file: convert it, or send JSON as application/json"
        ) from None
    if width * height > 1e6 * limits.megapixels:
        raise Refusal(
            413,
            f"the image has {width} x {height} pixels, more than {limits.megapixels:g} million: "
            "scale it down",
        )


def _camera_from_exif(data: bytes) -> Camera | None:
    """The camera of an image's EXIF data. pycolmap reads files: this one is in memory only."""
    from protomark.geometry.camera_files import camera_from_exif

    if not hasattr(os, "memfd_create"):
        return None
    with os.fdopen(os.memfd_create("image"), "wb") as file:
        file.write(data)
        file.flush()
        return camera_from_exif(Path(f"/proc/self/fd/{file.fileno()}"))


def feature_camera(given: Camera | None, known: tuple[Camera, ...]) -> Camera:
    """The camera of features: the given one, or the only one of the map.

    Raises:
        ValueError: none is given, and the map has none or several.
    """
    if given is not None:
        return given
    if len(known) != 1:
        raise ValueError(
            f"camera: features need one, as the map has {len(known)}: write, for example, "
            f"{CAMERA_EXAMPLE.rpartition('or ')[2]}"
        )
    return known[0]
