"""Places of a map: ranges of landmarks whose coordinates have nothing to do with each other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.maps.origin import map_sources


@dataclass(frozen=True)
class Place:
    """Landmarks with ids from `first` to `last`."""

    name: str
    first: int
    last: int

    def holds(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether each id is of this place."""
        return (ids >= self.first) & (ids <= self.last)


def map_places(scene: pm.PrototypeMap | pm.SealedMap) -> list[Place]:
    """The places that a map was built of, by their ids; none if it is one, or nobody stored them.

    Sources whose ids overlap, as of maps that were merged, are one place.
    """
    found = sorted(
        (place for source in map_sources(scene) for place in _places(source)),
        key=lambda place: (place.first, place.last),
    )
    if len(found) < 2 or any(a.last >= b.first for a, b in pairwise(found)):
        return []
    return found


def _places(source: dict[str, Any]) -> Iterator[Place]:
    """A source, or each map of it that has a world of its own."""
    maps = source.get("maps")
    parts = [m for m in maps if isinstance(m, dict)] if isinstance(maps, list) else []
    if len(parts) > 1 and all("ids" in part for part in parts):
        named = [(f"{source.get('name')}, map {part.get('id')}", part) for part in parts]
    else:
        named = [(str(source.get("name")), source)]
    for name, part in named:
        match part.get("ids"):
            case [int(first), int(last)] if 0 <= first <= last:
                yield Place(name, first, last)
