"""What a map was built from, and how its images were described, as JSON in its metadata."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import protomark as pm
from protomark.report import first_of

SOURCES, DETECTOR = "sources", "detector"
_MAX_BYTES = 1 << 16  # of a text in a map


def origin_texts(
    sources: Sequence[Mapping[str, Any]], detectors: Sequence[Mapping[str, Any]]
) -> dict[str, str]:
    """Metadata that name sources, and the detector of their images if that is known to be one."""
    texts = {SOURCES: _sources_text(sources)}
    different = {json.dumps(detector, sort_keys=True) for detector in detectors}
    if len(different) == 1 and any(detectors):
        texts[DETECTOR] = different.pop()
    return texts


def _sources_text(sources: Sequence[Mapping[str, Any]]) -> str:
    """The sources as JSON, without details where there are too many for a text."""
    for kept in (None, {"name", "program", "version", "ids"}, {"program"}):
        rows = [{k: v for k, v in one.items() if kept is None or k in kept} for one in sources]
        text = json.dumps(rows, ensure_ascii=False)
        if len(text.encode()) <= _MAX_BYTES:
            return text
    return "[]"


def map_detector(scene: pm.PrototypeMap | pm.SealedMap) -> dict[str, Any]:
    """The detector of the images that a map was built from, by name, with its settings.

    Empty if nobody stored it, or if its sources had several.
    """
    found = _parsed(scene.metadata.get(DETECTOR, "{}"))
    return found if isinstance(found, dict) else {}


def source_rows(text: str) -> Iterator[tuple[str, str]]:
    """Names of a map's sources and what is known of each, by its metadata `SOURCES`."""
    sources = _parsed(text)
    for one in sources if isinstance(sources, list) else []:
        if isinstance(one, dict):
            yield f"source: {one.get('name', '')}", "; ".join(_source_words(one))


def _source_words(one: Mapping[str, Any]) -> Iterator[str]:
    version = one.get("version", "unknown")
    yield f"{one.get('program')} {'' if version == 'unknown' else version}".strip()
    counts = [f"{one[k]:,} {k}" for k in _COUNTED if isinstance(one.get(k), int)]
    if counts:
        yield ", ".join(counts)
    maps = one.get("maps")
    if isinstance(maps, list) and len(maps) > 1:
        yield f"{len(maps)} maps, each in coordinates of its own"
    if "note" in one:
        yield str(one["note"])
    dropped = one.get("dropped")
    if isinstance(dropped, dict) and dropped:
        yield "left out: " + first_of([f"{n} {reason}" for reason, n in dropped.items()])


_COUNTED = ("keyframes", "landmarks", "observations")


def _parsed(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None  # somebody else's text under this name
