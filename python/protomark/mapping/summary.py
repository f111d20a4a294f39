"""The figures of a map that was made."""

from __future__ import annotations

from typing import Any

import numpy as np

from protomark.mapping.clock import STAGES
from protomark.mapping.history import REGISTERED
from protomark.mapping.mapper import Mapper
from protomark.mapping.memory import Prototypes

_LENGTHS = (2, 3, 4, 5, 6, 8, 11, 16, 31)


def summarise(mapper: Mapper) -> dict[str, Any]:
    """Counts, errors, bytes and times, for JSON."""
    structure = mapper.structure
    entries = list(mapper.history.entries.values())
    registered = [e for e in entries if e.outcome == REGISTERED]
    ids = structure.ids
    lengths = structure.counts(keyframes_only=False)[ids]
    seen = structure.observations(range(len(structure.frames)))
    errors = structure.errors(seen)
    errors = errors[np.isfinite(errors)]
    seconds = dict.fromkeys(STAGES, 0.0)
    for parts in (*(e.seconds for e in entries), mapper.history.later):
        for name, value in parts.items():
            seconds[name] += value
    unfound: dict[str, list[str]] = {}
    for entry in entries:
        if entry.outcome != REGISTERED:
            unfound.setdefault(entry.outcome, []).append(entry.name)
    camera = mapper.camera
    total = sum(seconds.values())
    return {
        "frames": len(entries),
        "registered": len(registered),
        "keyframes": sum(f.keyframe for f in structure.frames),
        "landmarks": len(ids),
        "observations": len(seen.landmarks),
        "track_length_mean": float(lengths.mean()) if len(lengths) else 0.0,
        "track_length_histogram": histogram(lengths),
        "reprojection_error_mean": float(errors.mean()) if len(errors) else 0.0,
        "reprojection_error_median": float(np.median(errors)) if len(errors) else 0.0,
        "memory": mapper.settings.memory,
        "descriptor": mapper.settings.descriptor,
        "bytes_per_landmark": mapper.memory.bytes / max(len(ids), 1),
        "memory_bytes": mapper.memory.bytes,
        "descriptor_bytes": mapper.width * len(seen.landmarks),
        "open_map_bytes": (2 * mapper.memory.dim + 1) * len(ids)
        if isinstance(mapper.memory, Prototypes)
        else None,
        "camera": camera.as_dict(),
        "seconds": {name: round(value, 3) for name, value in seconds.items()},
        "seconds_total": round(total, 3),
        "frames_per_second": len(entries) / total if total else 0.0,
        "events": mapper.history.events,
        "not_registered": unfound,
    }


def histogram(lengths: np.ndarray[Any, Any]) -> dict[str, int]:
    """Number of landmarks by their number of observations."""
    out = {}
    ends = [*(n - 1 for n in _LENGTHS[1:]), None]
    for first, last in zip(_LENGTHS, ends, strict=True):
        label = f"{first}" if last == first else f"{first}-{last}" if last else f"{first}+"
        inside = (lengths >= first) & (lengths <= (last if last else np.inf))
        out[label] = int(inside.sum())
    return out
