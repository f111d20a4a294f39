"""Places of a map: ranges of landmarks whose coordinates have nothing to do with each other."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

KEY = "places"
MAX_TEXT = 1 << 16  # bytes of a text in a map


@dataclass(frozen=True)
class Place:
    """Landmarks with ids from `first` to `last`."""

    name: str
    first: int
    last: int

    def holds(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether each id is of this place."""
        return (ids >= self.first) & (ids <= self.last)


def places_text(sources: Sequence[Mapping[str, Any]]) -> str:
    """The text of a map's metadata `KEY` by facts on its sources; "" if these are one place."""
    places = [place for source in sources for place in _places(source)]
    if len(places) < 2:
        return ""
    text = json.dumps([[p.name, p.first, p.last] for p in places], ensure_ascii=False)
    if len(text.encode()) > MAX_TEXT:
        text = json.dumps([["", p.first, p.last] for p in places])
    return text


def _places(source: Mapping[str, Any]) -> Iterator[Place]:
    """A source, or each map of it that has a world of its own."""
    parts = [part for part in source.get("maps", []) if "ids" in part]
    if len(parts) > 1:
        for part in parts:
            yield Place(f"{source['name']}, map {part['id']}", *part["ids"])
    else:
        yield Place(source["name"], *source["ids"])


def map_places(metadata: Mapping[str, str]) -> list[Place]:
    """The places of a map, by their ids, as its metadata tell; none if it is one place."""
    try:
        places = [Place(name, first, last) for name, first, last in json.loads(metadata[KEY])]
        places.sort(key=lambda place: place.first)
        fits = all(a.last < b.first for a, b in pairwise(places))
        fits &= all(isinstance(p.name, str) and 0 <= p.first <= p.last for p in places)
    except KeyError:
        return []
    except (TypeError, ValueError, RecursionError):
        fits = False
    if not fits:
        raise ValueError(f"the map's metadata {KEY!r} hold no list of name, first and last id")
    return places
