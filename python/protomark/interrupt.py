"""Defers Ctrl-C and SIGTERM until long work is between two steps.

While the command still imports, Ctrl-C ends it without a traceback.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


class Interrupted(Exception):  # noqa: N818 - like KeyboardInterrupt
    """Ctrl-C ended long work between two steps; the message says how to continue."""


def _exit(number: int, frame: FrameType | None) -> None:
    os._exit(130)


# `python -m` has put "-m" in place of the script's name while it imports the package.
if os.path.basename(sys.argv[0]) in ("protomark", "-m") and (
    signal.getsignal(signal.SIGINT) is signal.default_int_handler
):
    signal.signal(signal.SIGINT, _exit)

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
# Seconds after a signal within which the step at hand may still end.
_PATIENCE = 3.0
_requested_at: float | None = None


@contextmanager
def deferred_interrupt(notify: Callable[[], None] = lambda: None) -> Iterator[Callable[[], bool]]:
    """Yield a function that tells whether Ctrl-C or SIGTERM has asked the work to stop.

    The work calls it between two steps. A second signal raises KeyboardInterrupt at once. Outside
    of the main thread, where Python handles no signals, the function always returns False.

    Args:
        notify: called on the first signal, to tell the user that the work is about to stop.
    """
    requested = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield requested.is_set
        return

    def request(number: int, frame: FrameType | None) -> None:
        global _requested_at
        if requested.is_set():
            raise KeyboardInterrupt
        requested.set()
        _requested_at = time.monotonic()
        notify()

    before = [signal.signal(number, request) for number in _SIGNALS]
    try:
        yield requested.is_set
    finally:
        _forget()
        for number, handler in zip(_SIGNALS, before, strict=True):
            signal.signal(number, handler)


def raise_if_overdue() -> None:
    """Raise KeyboardInterrupt if the step at hand goes on for long after a deferred signal.

    Long steps call it between parts that leave nothing behind.
    """
    if _requested_at is not None and time.monotonic() - _requested_at > _PATIENCE:
        raise KeyboardInterrupt


def _forget() -> None:
    global _requested_at
    _requested_at = None
