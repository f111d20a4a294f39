"""Ctrl-C and SIGTERM at a moment that suits long work: between two steps of it."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


class Interrupted(Exception):  # noqa: N818 - like KeyboardInterrupt
    """Ctrl-C ended long work between two steps; the message says how to continue."""


_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def deferred_interrupt(notify: Callable[[], None] = lambda: None) -> Iterator[Callable[[], bool]]:
    """Within the context the first Ctrl-C or SIGTERM only sets the flag that this yields.

    The work reads the flag between two steps, and stops. A second signal raises KeyboardInterrupt
    at once. Outside of the main thread, where Python takes no signals, the flag is never set.

    Args:
        notify: called when the flag is set, to tell the user that the work is about to stop.
    """
    requested = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield requested.is_set
        return

    def request(number: int, frame: FrameType | None) -> None:
        if requested.is_set():
            raise KeyboardInterrupt
        requested.set()
        notify()

    before = [signal.signal(number, request) for number in _SIGNALS]
    try:
        yield requested.is_set
    finally:
        for number, handler in zip(_SIGNALS, before, strict=True):
            signal.signal(number, handler)
