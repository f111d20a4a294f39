"""The interface of peers' approximate indexes, and a cache for those that take long to build."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from protomark.files import write_text

T = TypeVar("T")

# Returns the rows (n,) nearest to the first n queries, -1 for none.
Search = Callable[[int], NDArray[np.int64]]

K = 2  # neighbours in every search, as a ratio test needs two


@dataclass(frozen=True)
class IndexQueries:
    """Queries, and numbers of threads.

    Attributes:
        codes: (q, dim) int8.
        threads: threads to search on.
        build_threads: threads to build on.
    """

    codes: NDArray[np.int8]
    threads: int
    build_threads: int

    @cached_property
    def floats(self) -> NDArray[np.float32]:
        """(q, dim) float32, the same queries."""
        return self.codes.astype(np.float32)


@dataclass
class TunableIndex:
    """An index that is built, and can be searched at any of its settings.

    Attributes:
        prepare: returns the search at a setting.
        settings: lines of settings for `approximate.tune`; a number n: the line 1, 2, 3, 4, 6, 8,
            ... n.
        bytes: bytes of the whole index when stored.
        setting: name of the setting.
        note: how the index was built.
        more: bytes per landmark beyond those of an exact search, None if unknown.
        seconds: seconds to build it; None: those of the call that returned it.
    """

    prepare: Callable[[Any], Search]
    settings: int | Sequence[Sequence[Any]]
    bytes: int
    setting: str
    note: str = ""
    more: float | None = None
    seconds: float | None = None

    @property
    def lines(self) -> Sequence[Sequence[Any]]:
        """The lines of settings."""
        return [doubling(1, self.settings)] if isinstance(self.settings, int) else self.settings


def doubling(first: int, last: int) -> list[int]:
    """The numbers first, 2 first, ... up to last, and one between each two."""
    values = [first]
    while values[-1] < last:
        values += [max(values[-1] * 3 // 2, values[-1] + 1), values[-1] * 2]
    return sorted({value for value in values if value <= last})


class IndexCache:
    """A folder of indexes by the digest of their content; None: every index is built anew."""

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder

    def get(
        self,
        label: str,
        distribution: str,
        rows: NDArray[np.int8],
        build: Callable[[], T],
        write: Callable[[T, Path], None],
        read: Callable[[Path], T],
    ) -> tuple[T, float]:
        """An index of `rows` (n, d), and the seconds that it took to build.

        Args:
            label: kind and parameters of the index.
            distribution: the package that builds it, whose version counts, too.
            rows: the content of the index.
            build: builds the index.
            write: writes the index.
            read: reads an index that `write` wrote.

        Raises:
            OSError: the folder cannot be written.
        """
        if self._folder is None:
            return _timed(build)
        self._folder.mkdir(parents=True, exist_ok=True)
        key = hashlib.sha256(f"{label} {version(distribution)} {rows.shape}".encode())
        key.update(np.ascontiguousarray(rows).data)
        path = self._folder / f"{distribution}-{key.hexdigest()[:16]}"
        # This file is written last, so an index without it is incomplete.
        facts = path.with_suffix(".json")
        if facts.exists():
            return read(path), float(json.loads(facts.read_text())["seconds"])
        index, seconds = _timed(build)
        write(index, path)
        write_text(facts, json.dumps({"label": label, "rows": len(rows), "seconds": seconds}))
        return index, seconds


def _timed(build: Callable[[], T]) -> tuple[T, float]:
    begin = time.perf_counter()
    return build(), time.perf_counter() - begin
