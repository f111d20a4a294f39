"""An approximate index of a peer, as the bench sees it, and a cache of those that take long."""

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

Search = Callable[[int], NDArray[np.int64]]
"""Rows nearest to each of the first n queries, (n,), -1 where nothing was found."""

K = 2  # neighbours that every search asks for, as a ratio test needs them


@dataclass(frozen=True)
class IndexQueries:
    """What an index is asked, and on how many threads.

    Attributes:
        codes: (q, dim) int8.
        threads: of a search.
        build_threads: of building.
    """

    codes: NDArray[np.int8]
    threads: int
    build_threads: int

    @cached_property
    def floats(self) -> NDArray[np.float32]:
        """(q, dim) the same as float32."""
        return self.codes.astype(np.float32)


@dataclass
class TunableIndex:
    """Built, and ready to be searched with any of its settings.

    Attributes:
        prepare: makes the search of a setting.
        settings: lines of settings, as `approximate.tune` takes them; a number n: one line,
            1, 2, 3, 4, 6, 8, ... n.
        bytes: of the whole index, as it would be stored.
        setting: the name of the setting.
        note: how it was built.
        more: bytes per landmark beyond what an exact search needs, where that is known.
        seconds: that it took to build, if not as long as the call that gave it.
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
    """first, 2 first, ... up to last, with a step in between each."""
    values = [first]
    while values[-1] < last:
        values += [max(values[-1] * 3 // 2, values[-1] + 1), values[-1] * 2]
    return sorted({value for value in values if value <= last})


class IndexCache:
    """A folder of indexes, named by what they are built from; None: every index is built anew."""

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
        """An index of `rows` (n, d), and the seconds that it took to build, now or once.

        Args:
            label: what distinguishes it from other indexes of the same rows, parameters included.
            distribution: the package that builds it; another version builds its own.
            rows: what is in it.
            build: makes it.
            write: stores it.
            read: loads what `write` stored.

        Raises:
            OSError: the folder cannot be written.
        """
        if self._folder is None:
            return _timed(build)
        self._folder.mkdir(parents=True, exist_ok=True)
        key = hashlib.sha256(f"{label} {version(distribution)} {rows.shape}".encode())
        key.update(np.ascontiguousarray(rows).data)
        path = self._folder / f"{distribution}-{key.hexdigest()[:16]}"
        # Written last: an index without it was cut short.
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
