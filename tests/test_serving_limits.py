"""What a server does when it is late, left alone, or wrong."""

from __future__ import annotations

import asyncio
import json
import logging
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

import protomark as pm
from protomark import sample
from protomark.maps.build import build_map

pytest.importorskip("fastapi_offline")
from protomark.serving import service
from protomark.serving.reading import Limits, Refusal
from protomark.serving.workers import Gone, Workers


class Client:
    """A request whose client hangs up after so many seconds."""

    def __init__(self, patience: float = 60) -> None:
        self._patience = patience

    async def receive(self) -> dict[str, str]:
        await asyncio.sleep(self._patience)
        return {"type": "http.disconnect"}


def ran(
    workers: Workers, work: Callable[[float], Any], seconds: float, patience: float = 60
) -> Any:
    async def run() -> Any:
        with workers.slot():
            deadline = time.monotonic() + seconds
            return await workers.run(work, Client(patience), deadline)  # type: ignore[arg-type]

    return run()


def test_late_answers_keep_their_slot_until_their_thread_is_free() -> None:
    workers = Workers(Limits(seconds=0.2, threads=1, waiting=1))
    free = threading.Event()

    async def steps() -> None:
        stuck = asyncio.ensure_future(ran(workers, lambda _: free.wait(), 0.2))
        await asyncio.sleep(0.05)
        with pytest.raises(Refusal, match=r"no thread was free within 0\.2 s") as late:
            await ran(workers, lambda _: None, 0.05)
        assert (late.value.status, late.value.headers) == (503, {"Retry-After": "1"})
        with pytest.raises(Refusal, match=r"took longer than 0\.2 s") as gave_up:
            await stuck
        assert gave_up.value.status == 504
        assert workers.in_progress == 1
        # One may wait, the next one not.
        waiting = asyncio.ensure_future(ran(workers, lambda waited: waited, 10))
        await asyncio.sleep(0.05)
        assert workers.waiting == 1
        with pytest.raises(Refusal, match="busy"):
            await ran(workers, lambda _: None, 1)
        # Who hangs up leaves the queue.
        waiting.cancel()
        await asyncio.sleep(0)
        began: list[float] = []
        with pytest.raises(Gone):
            await ran(workers, began.append, 10, patience=0.05)
        # Nobody waits for what will come too late.
        slow = Workers(Limits(seconds=0.3, threads=1, waiting=9))
        await ran(slow, lambda _: time.sleep(0.25), 10)
        running = [asyncio.ensure_future(ran(slow, lambda _: free.wait(), 10)) for _ in range(3)]
        await asyncio.sleep(0.05)
        with pytest.raises(Refusal, match=r"busy \(2 requests wait already\)"):
            await ran(slow, lambda _: None, 10)
        free.set()
        await asyncio.gather(*running)
        slow.close()
        assert await ran(workers, lambda waited: waited, 10) < 5
        assert (workers.in_progress, began) == (0, [])

    asyncio.run(steps())
    workers.close()


def test_a_fault_is_a_sentence_to_the_client_and_a_place_in_the_log(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    sent_by_client = "a" * 9  # the log shows lines of code

    def fail(*_: Any) -> None:
        raise ZeroDivisionError(sent_by_client)

    monkeypatch.setattr(service, "answer_of", fail)
    monkeypatch.setattr(logging.getLogger("protomark.serving"), "propagate", True)
    scene = build_map(sample.load(), pm.Encoder.load("freak"), 32)
    app = service.make_app(pm.Localizer(scene), Limits(), list)
    sent: list[dict[str, Any]] = []
    body = [{"type": "http.request", "body": b"x"}]

    async def receive() -> dict[str, Any]:
        if body:
            return body.pop()
        await asyncio.sleep(60)
        raise AssertionError

    async def send(message: Any) -> None:
        sent.append(message)

    scope = {"type": "http", "method": "POST", "path": "/localize", "headers": []}
    asyncio.run(app({**scope, "query_string": b"", "http_version": "1.1"}, receive, send))
    assert sent[0]["status"] == 500
    assert json.loads(sent[1]["body"]) == {
        "detail": "the server failed at this request, and its log says where"
    }
    assert "ZeroDivisionError in a request" in caplog.text
    assert "in fail" in caplog.text
    assert sent_by_client not in caplog.text
