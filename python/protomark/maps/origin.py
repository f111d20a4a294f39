"""What a map was built from, and how its images were described, as JSON in its metadata."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import protomark as pm
from protomark.geometry.camera import Camera
from protomark.maps.cameras import KEY, cameras_text
from protomark.maps.places import KEY as PLACES
from protomark.maps.places import MAX_TEXT, places_text
from protomark.report import first_of
from protomark.tracks.file import Tracks
from protomark.tracks.joining import shifted_ids

SOURCES, DETECTOR = "sources", "detector"
# What `sources_metadata` says; all else is the user's.
OF_SOURCES = (KEY, SOURCES, PLACES, DETECTOR)
LIMIT = "max_keypoints"  # of a detector
_COUNTED = ("keyframes", "landmarks", "observations")


def tracks_metadata(tracks: Tracks) -> dict[str, str]:
    """The metadata of a map of tracks that `protomark.maps.sources.read_places` read."""
    info = tracks.info
    return sources_metadata(info["sources"], info["detectors"], tracks.cameras.values())


def sources_metadata(
    sources: Sequence[Mapping[str, Any]],
    detectors: Sequence[Mapping[str, Any]],
    cameras: Iterable[Camera],
) -> dict[str, str]:
    """The metadata of a map by facts on its sources, their detectors and all cameras.

    They name cameras, sources, places if there are several, and the detector if all sources had
    the same.
    """
    texts = {KEY: cameras_text(cameras), SOURCES: _sources_text(sources)}
    if places := places_text(sources):
        texts[PLACES] = places
    if detector := _joint_detector(detectors):
        texts[DETECTOR] = json.dumps(detector, sort_keys=True)
    return texts


def joint_origin(
    target: Mapping[str, str], source: Mapping[str, str], shift: int = 0
) -> dict[str, str]:
    """What a map says of its origin once another one is merged into it.

    Args:
        target: metadata of the map.
        source: metadata of the other.
        shift: what is added to the ids of the other.

    Raises:
        ValueError: they have different places.
    """
    if target.get(PLACES) != source.get(PLACES):
        raise ValueError(
            "a map of several places, each with coordinates of its own, can be merged with parts "
            "of itself only: build a map of each place, and merge these"
        )
    texts = {}
    sources = [*_sources(target), *(shifted_ids(one, shift) for one in _sources(source))]
    if sources:
        texts[SOURCES] = _sources_text([s for i, s in enumerate(sources) if s not in sources[:i]])
    if target.get(DETECTOR) != source.get(DETECTOR):
        detectors = [_detector(one) for one in (target, source)]
        texts[DETECTOR] = json.dumps(_joint_detector(detectors), sort_keys=True)
    return texts


def _joint_detector(detectors: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The detector that all are but for the number of keypoints, whose largest counts; or none."""
    plain = [{k: v for k, v in one.items() if k != LIMIT} for one in detectors]
    if any(one != plain[0] for one in plain):
        return {}
    limits = [n for one in detectors if isinstance(n := one.get(LIMIT), int)]
    return plain[0] | ({LIMIT: max(limits)} if limits else {})


def _sources_text(sources: Sequence[Mapping[str, Any]]) -> str:
    """The sources as JSON, without details where there are too many for a text."""
    for kept in (None, {"name", "program", "version", "ids"}, {"program"}):
        rows = [{k: v for k, v in one.items() if kept is None or k in kept} for one in sources]
        text = json.dumps(rows, ensure_ascii=False)
        if len(text.encode()) <= MAX_TEXT:
            return text
    return "[]"


def map_detector(scene: pm.PrototypeMap | pm.SealedMap | pm.ShardedMap) -> dict[str, Any]:
    """The detector of the images that a map was built from, by name, with its settings.

    Empty if nobody stored it, or if its sources had several.
    """
    return _detector(scene.metadata)


def _detector(metadata: Mapping[str, str]) -> dict[str, Any]:
    found = _parsed(metadata.get(DETECTOR, "{}"))
    return found if isinstance(found, dict) else {}


def source_rows(metadata: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Names of a map's sources, and what is known of each."""
    for one in _sources(metadata):
        yield f"source: {one.get('name', '')}", "; ".join(_source_words(one))


def _sources(metadata: Mapping[str, str]) -> list[dict[str, Any]]:
    found = _parsed(metadata.get(SOURCES, "[]"))
    return [one for one in found if isinstance(one, dict)] if isinstance(found, list) else []


def _source_words(one: Mapping[str, Any]) -> Iterator[str]:
    version = one.get("version", "unknown")
    yield f"{one.get('program')} {'' if version == 'unknown' else version}".strip()
    counts = [f"{one[k]:,} {k}" for k in _COUNTED if isinstance(one.get(k), int)]
    if counts:
        yield ", ".join(counts)
    cameras = one.get("cameras")
    if isinstance(cameras, list):
        yield f"{one.get('descriptor')} of {first_of([str(camera) for camera in cameras])}"
    maps = one.get("maps")
    if isinstance(maps, list) and len(maps) > 1:
        yield f"{len(maps)} maps, each in coordinates of its own"
    if "note" in one:
        yield str(one["note"])
    dropped = one.get("dropped")
    if isinstance(dropped, dict) and dropped:
        yield "left out: " + first_of([f"{n} {reason}" for reason, n in dropped.items()])


def _parsed(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None  # somebody else's text under this name
