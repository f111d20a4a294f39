"""How library functions report progress: they call a function, and commands draw a bar."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sized
from typing import TypeVar

T = TypeVar("T")

# Called with the name of a stage, the steps done and the steps in all (0: unknown).
Progress = Callable[[str, int, int], None]


def silent(stage: str, done: int, total: int) -> None:
    """Report nothing."""


def tracked(
    items: Iterable[T], progress: Progress, stage: str, total: int | None = None
) -> Iterator[T]:
    """Iterate over items and report each as a step of a stage.

    Args:
        items: what to iterate over.
        progress: called before the first item and after each.
        stage: name of the stage.
        total: number of items; None: `len(items)`, or unknown.
    """
    if total is None:
        total = len(items) if isinstance(items, Sized) else 0
    progress(stage, 0, total)
    for done, item in enumerate(items, 1):
        yield item
        progress(stage, done, total)
