"""A bounded pool of threads: what does not fit is refused at once, and what is late in time."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

from starlette.requests import Request

from protomark.serving.reading import Limits, Refusal

T = TypeVar("T")

# Share of the latest request in the running mean of seconds per request.
_LATEST = 0.1


class Gone(Exception):  # noqa: N818 - nobody's error
    """The client has hung up."""


class Workers:
    """Threads that compute, and the requests that wait for one. Its methods are the event loop's.

    Args:
        limits: numbers of threads and of waiting requests, and seconds per request.
    """

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._threads = ThreadPoolExecutor(limits.threads, "localize")
        self._seconds = 0.1  # running mean per request
        self.in_progress = 0  # requests that have a slot, and what runs although it was given up

    @property
    def waiting(self) -> int:
        """Number of requests in progress beyond the threads."""
        return max(0, self.in_progress - self._limits.threads)

    @contextmanager
    def slot(self) -> Iterator[None]:
        """Hold a slot for a request from before its body is read until it is answered.

        Raises:
            Refusal: no slot is free.
        """
        full = self.in_progress >= self._limits.threads + self._limits.waiting
        if full or (self.waiting and self._expected() > self._limits.seconds):
            raise self._busy(f"{self.waiting} requests wait already")
        self.in_progress += 1
        try:
            yield
        finally:
            self.in_progress -= 1

    async def run(self, work: Callable[[float], T], request: Request, deadline: float) -> T:
        """What `work` returns on one of the threads; it is told how many seconds it waited.

        Args:
            work: the function to call.
            request: the request that it is for, whose body was read.
            deadline: when the answer must be there, by `time.monotonic`.

        Raises:
            Refusal: it is not.
            Gone: the client hung up before work began.
        """
        submitted = time.monotonic()
        job = self._threads.submit(self._timed, work, submitted)
        done = asyncio.ensure_future(asyncio.wrap_future(job))
        hung_up = asyncio.ensure_future(_hung_up(request))
        try:
            futures: set[asyncio.Future[Any]] = {done, hung_up}
            await asyncio.wait(
                futures,
                timeout=max(0.0, deadline - submitted),
                return_when=asyncio.FIRST_COMPLETED,
            )
            if done.done():
                return done.result()
            if job.cancel():
                if hung_up.done():
                    raise Gone
                raise self._busy(f"no thread was free within {self._limits.seconds:g} s")
            self._let_end(job)
            if hung_up.done():
                raise Gone
            raise Refusal(
                504,
                f"the answer took longer than {self._limits.seconds:g} s: send fewer keypoints or "
                "a smaller image, or have the server started with a larger --timeout",
            )
        finally:
            hung_up.cancel()
            done.cancel()

    def close(self) -> None:
        """End the threads; what has not begun never will."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    def _timed(self, work: Callable[[float], T], submitted: float) -> T:
        began = time.monotonic()
        try:
            return work(began - submitted)
        finally:
            self._seconds += _LATEST * (time.monotonic() - began - self._seconds)

    def _let_end(self, job: Future[T]) -> None:
        """Count a slot as taken until a thread ends what nobody waits for."""
        loop = asyncio.get_running_loop()
        self.in_progress += 1

        def ended(_: Future[T]) -> None:
            with suppress(RuntimeError):  # the loop has ended before
                loop.call_soon_threadsafe(self._free)

        job.add_done_callback(ended)

    def _free(self) -> None:
        self.in_progress -= 1

    def _expected(self) -> float:
        """Seconds until all requests in progress are answered, about."""
        return self._seconds * self.in_progress / self._limits.threads

    def _busy(self, cause: str) -> Refusal:
        seconds = max(1, math.ceil(self._expected()))
        sentence = f"the server is busy ({cause}): try again in {seconds} s"
        return Refusal(503, sentence, retry_after=seconds)


async def _hung_up(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
