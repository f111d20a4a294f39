"""What a server tells its operator: figures in the text format of Prometheus, and a log."""

from __future__ import annotations

import logging
import time
import traceback
from collections.abc import Callable
from typing import Any

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    Info,
    ProcessCollector,
    disable_created_metrics,
    generate_latest,
)

from protomark import __version__
from protomark.serving.messages import Answer
from protomark.serving.workers import Workers

log = logging.getLogger("protomark.serving")
disable_created_metrics()  # type: ignore[no-untyped-call]
CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_SECONDS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1, 2, 5, 10, 30)
_BYTES = (1e4, 1e5, 3e5, 1e6, 3e6, 1e7, 3e7)
_SHARES = (0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1)


class Metrics:
    """Counts requests by outcome, and measures how long their stages take.

    Args:
        workers: whose queue to report.
        landmarks: says how many landmarks the map has.
    """

    def __init__(self, workers: Workers, landmarks: Callable[[], int]) -> None:
        registry = self._registry = CollectorRegistry()
        ProcessCollector(registry=registry)
        Info("protomark", "What runs here.", registry=registry).info({"version": __version__})
        for name, text, value in (
            ("map_landmarks", "Landmarks of the map.", landmarks),
            ("requests_in_progress", "Requests to /localize now.", lambda: workers.in_progress),
            ("requests_waiting", "Those that wait for a thread.", lambda: workers.waiting),
        ):
            Gauge(f"protomark_{name}", text, registry=registry).set_function(value)
        self._requests = Counter(
            "protomark_requests",
            "Requests to /localize by status and outcome.",
            ["status", "outcome"],
            registry=registry,
        )
        self._seconds = Histogram(
            "protomark_request_seconds",
            "Seconds from a request to its answer, whatever that is.",
            buckets=_SECONDS,
            registry=registry,
        )
        self._bytes = Histogram(
            "protomark_request_bytes", "Bytes of a body.", buckets=_BYTES, registry=registry
        )
        self._stages = Histogram(
            "protomark_stage_seconds",
            "Seconds of each stage of a localization.",
            ["stage"],
            buckets=_SECONDS,
            registry=registry,
        )
        self._confidence = Histogram(
            "protomark_confidence",
            "Of answers, 0 without a pose.",
            buckets=_SHARES,
            registry=registry,
        )

    def answered(self, answer: Answer) -> None:
        """Count a localization."""
        self._confidence.observe(answer.confidence)
        for stage, seconds in answer.seconds.items():
            if stage != "total":
                self._stages.labels(stage).observe(seconds)

    def ended(self, status: int, outcome: str, size: int, seconds: float) -> None:
        """Count a request to /localize."""
        self._requests.labels(str(status), outcome).inc()
        self._seconds.observe(seconds)
        self._bytes.observe(size)

    def text(self) -> bytes:
        """All figures."""
        return generate_latest(self._registry)


class Observed:
    """Logs and counts requests by size, time and outcome; errors reach the log, never a client."""

    def __init__(self, app: Any, figures: Metrics, failed: Any) -> None:
        self._app, self._figures, self._failed = app, figures, failed

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Pass a request on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        began, size, status = time.perf_counter(), 0, 0
        state = scope.setdefault("state", {})

        async def receiving() -> Any:
            nonlocal size
            message = await receive()
            size += len(message.get("body", b""))
            state["received"] = not message.get("more_body")
            return message

        async def sending(message: Any) -> None:
            nonlocal status
            status = message.get("status", status)
            await send(message)

        try:
            await self._app(scope, receiving, sending)
        except Exception as error:
            # Not its message, which may hold what the client sent.
            where = "".join(traceback.format_tb(error.__traceback__))
            log.error("%s in a request:\n%s", type(error).__name__, where)
            if not status:
                await self._failed(scope, receive, sending)
        if scope["path"] != "/localize":
            return
        outcome = state.get("outcome", "refused" if status < 500 else "failed")
        if status == 503:
            outcome = "busy"
        seconds = time.perf_counter() - began
        self._figures.ended(status, outcome, size, seconds)
        log.info("%d %s, %d bytes, %.3f s", status, outcome, size, seconds)
