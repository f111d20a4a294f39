"""Progress of library functions: they call a function, for which commands draw a bar."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sized
from typing import TypeVar

T = TypeVar("T")

# Called with the name of a stage, the number of finished steps, and that of all (0: unknown).
Progress = Callable[[str, int, int], None]


def silent(stage: str, done: int, total: int) -> None:
    """Report nothing."""


def tracked(
    items: Iterable[T], progress: Progress, stage: str, total: int | None = None
) -> Iterator[T]:
    """Iterate over items and report each as a step of a stage; `total` is `len(items)` if None."""
    if total is None:
        total = len(items) if isinstance(items, Sized) else 0
    progress(stage, 0, total)
    for done, item in enumerate(items, 1):
        yield item
        progress(stage, done, total)
