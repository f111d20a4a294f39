"""Summarises a map for its report: figures, and the data of its pictures."""

from __future__ import annotations

from typing import Any

import numpy as np

from protomark.features.static_regions import describe
from protomark.mapping.clock import STAGES
from protomark.mapping.history import REGISTERED
from protomark.mapping.mapper import Mapper
from protomark.mapping.trust import warnings
from protomark.plot import MapPictures
from protomark.tracks.summary import track_figures


def summarise(mapper: Mapper, finished: bool = True) -> dict[str, Any]:
    """Counts, errors, bytes and times of a map, as JSON values; a stopped one is not judged."""
    structure = mapper.structure
    records = list(mapper.history.records.values())
    registered = [r for r in records if r.outcome == REGISTERED]
    ids = structure.ids
    lengths = structure.counts(keyframes_only=False)[ids]
    seen = structure.observations(range(len(structure.frames)))
    errors = structure.errors(seen)
    errors = errors[np.isfinite(errors)]
    seconds = mapper.history.total_seconds()
    unregistered: dict[str, list[str]] = {}
    for record in records:
        if record.outcome != REGISTERED:
            unregistered.setdefault(record.outcome, []).append(record.name)
    camera = mapper.camera
    total = sum(seconds.values())
    return {
        "frames": len(records),
        "registered": len(registered),
        "keyframes": sum(f.keyframe for f in structure.frames),
        "landmarks": len(ids),
        "observations": len(seen.landmarks),
        **track_figures(lengths, errors),
        "descriptor": mapper.options.descriptor,
        "bytes_per_landmark": mapper.memory.bytes / max(len(ids), 1),
        "memory_bytes": mapper.memory.bytes,
        "descriptor_bytes": mapper.descriptor_bytes * len(seen.landmarks),
        "camera": camera.as_dict(),
        "seconds": {name: round(value, 3) for name, value in seconds.items()},
        "seconds_total": round(total, 3),
        "frames_per_second": (len(records) - mapper.history.earlier) / total if total else 0.0,
        "left_out": "" if mapper.mask is None else describe(mapper.mask),
        "warnings": warnings(mapper) if finished else [],
        "events": mapper.history.events,
        "not_registered": unregistered,
    }


def map_pictures(mapper: Mapper, facts: dict[str, Any]) -> MapPictures:
    """The data of the report's pictures; `facts` is what `summarise` returned."""
    structure = mapper.structure
    errors = structure.errors(structure.observations(range(len(structure.frames))))
    frames = sorted(structure.frames, key=lambda f: (f.camera_id, f.index))
    return MapPictures(
        positions=structure.positions[structure.ids],
        counts=structure.counts(keyframes_only=False)[structure.ids],
        poses=np.array([frame.pose for frame in frames]).reshape(-1, 3, 4),
        errors=errors[np.isfinite(errors)],
        track_lengths=facts["track_length_histogram"],
        frames=[
            {**vars(record), "registered": record.outcome == REGISTERED}
            for record in mapper.history.records.values()
        ],
        stages=STAGES,
    )
