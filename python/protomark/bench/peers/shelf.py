"""Peers' indexes that took long to build, kept for later runs."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from protomark.files import write_text

T = TypeVar("T")


class Shelf:
    """A folder of indexes, named by what they are built from; without a folder nothing is kept."""

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder

    def built(
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
    began = time.perf_counter()
    return build(), time.perf_counter() - began
