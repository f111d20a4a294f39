"""What a server does when it is late, left alone, or wrong."""

from __future__ import annotations

import asyncio
import io
import json
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import protomark as pm
from protomark import sample
from protomark.maps.build import build_map

pytest.importorskip("fastapi_offline")
from mutation import SEED, mutated
from protomark.serving import service
from protomark.serving.answers import answer_of
from protomark.serving.messages import Settings
from protomark.serving.reading import Limits, Refusal, Upload
from protomark.serving.workers import Gone, Workers
from serving_client import Frame


@pytest.fixture(scope="module")
def localizer() -> pm.Localizer:
    return pm.Localizer(build_map(sample.load(), pm.Encoder.load("freak"), 32), max_keypoints=100)


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


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF", "BMP", "PPM", "tensors", "JSON"])
def test_broken_bodies_are_refused_in_a_sentence(localizer: pm.Localizer, kind: str) -> None:
    rng, frame = np.random.default_rng(SEED), Frame.of(3)
    few = replace(frame, keypoints=frame.keypoints[:9], descriptors=frame.descriptors[:9])
    whole = few.safetensors() if kind == "tensors" else json.dumps(few.json()).encode()
    if kind not in ("tensors", "JSON"):
        noise, file = rng.integers(0, 256, (48, 64), np.uint8), io.BytesIO()
        pytest.importorskip("PIL.Image").fromarray(noise).save(file, kind)
        whole = file.getvalue()
    refusals: list[Refusal] = []
    for _ in range(60):
        upload = Upload(mutated(whole, rng), Settings(), kind == "JSON")
        try:
            answer_of(localizer, upload, Limits(), 0.0)
        except Refusal as refusal:
            refusals.append(refusal)
    assert {refusal.status for refusal in refusals} <= {413, 422}
    assert refusals
    assert not any("\n" in str(refusal) for refusal in refusals)


def test_a_fault_is_a_sentence_to_the_client_and_a_place_in_the_log(
    localizer: pm.Localizer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    sent_by_client = "a" * 9  # the log shows lines of code

    def fail(*_: Any) -> None:
        raise ZeroDivisionError(sent_by_client)

    monkeypatch.setattr(service, "answer_of", fail)
    monkeypatch.setattr(logging.getLogger("protomark.serving"), "propagate", True)
    app = service.make_app(localizer, Limits(), list)
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
