"""An approximate index of a peer, as the bench sees it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Search = Callable[[int], NDArray[np.int64]]
"""Numbers of what is nearest to each of the first n queries, (n,), -1 where nothing was found."""

K = 2  # neighbours that every search asks for, as a ratio test needs them


@dataclass
class Index:
    """Built, and ready to be searched with any of its settings.

    Attributes:
        prepare: makes the search of a setting.
        lines: settings, as `tuning.tune` takes them.
        bytes: of the whole index, as it would be stored.
        more: bytes a landmark beyond what an exact search needs, where that is known.
        seconds: that it took to build, if not as long as the call that gave it.
        setting: what the settings are called.
        note: how it was built.
    """

    prepare: Callable[[Any], Search]
    lines: Sequence[Sequence[Any]]
    bytes: int
    setting: str
    note: str = ""
    more: float | None = None
    seconds: float | None = None


class Builder(Protocol):
    """Builds an index of `rows` (n, d) with `build_threads`, searched for `queries` (q, d)."""

    def __call__(
        self,
        rows: NDArray[Any],
        queries: NDArray[Any],
        threads: int,
        build_threads: int,
    ) -> Index:
        """The index."""


def doubling(first: int, last: int) -> list[int]:
    """first, 2 first, ... up to last, with a step in between each."""
    values = [first]
    while values[-1] < last:
        values += [max(values[-1] * 3 // 2, values[-1] + 1), values[-1] * 2]
    return sorted({value for value in values if value <= last})
