"""Measures how long each stage of mapping takes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

STAGES = ("detect", "encode", "initialise", "match", "triangulate", "adjust", "other")


class Clock:
    """Sums seconds by stage; time in a nested stage counts for the inner one only.

    Args:
        now: returns the time in seconds; `time.process_time` leaves other programs out.
    """

    def __init__(self, now: Callable[[], float] = time.perf_counter) -> None:
        self._now = now
        self.seconds: dict[str, float] = dict.fromkeys(STAGES, 0.0)
        self._running = ["other"]
        self._since = now()

    def _book(self) -> None:
        now = self._now()
        self.seconds[self._running[-1]] += now - self._since
        self._since = now

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the time inside the context as `name`."""
        self._book()
        self._running.append(name)
        try:
            yield
        finally:
            self._book()
            self._running.pop()

    def lap(self) -> dict[str, float]:
        """Seconds by stage since the last lap."""
        self._book()
        out, self.seconds = self.seconds, dict.fromkeys(STAGES, 0.0)
        return out
