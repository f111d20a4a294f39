"""Writes landmarks as a PLY file, for viewers of point clouds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark import PrototypeMap
from protomark.files import replacing
from protomark.maps.open import open_map
from protomark.tracks.file import Tracks

Points = tuple[NDArray[np.float64], NDArray[np.int64] | None]


def landmarks_of(source: Path, tracks: Tracks | None) -> Points:
    """Positions (l, 3), NaN where there is none, and numbers of observations (l,).

    A sealed map does not count observations.
    """
    if tracks is None:
        scene = open_map(source)
        counts = scene.counts(scene.ids) if isinstance(scene, PrototypeMap) else None
        return scene.positions(scene.ids), None if counts is None else counts.astype(np.int64)
    rows = np.searchsorted(tracks.landmark_ids, tracks.landmark_of_keypoint[tracks.observations])
    return tracks.landmark_positions, np.bincount(rows, minlength=len(tracks.landmark_ids))


def write_ply(
    output: Path,
    positions: NDArray[np.float64],
    counts: NDArray[np.int64] | None,
    colours: NDArray[np.uint8] | None = None,
) -> dict[str, Any]:
    """Write positions (l, 3), observations (l,) and colours (l, 3) of landmarks, binary.

    Raises:
        ValueError: no landmark has a position.
    """
    placed = np.isfinite(positions).all(axis=1)
    if not placed.any():
        raise ValueError("no landmark has a position, so there is nothing to draw")
    columns = [("x", "<f8", "double"), ("y", "<f8", "double"), ("z", "<f8", "double")]
    if counts is not None:
        columns += [("count", "<u4", "uint")]
    if colours is not None:
        columns += [(name, "u1", "uchar") for name in ("red", "green", "blue")]
    vertices = np.zeros(int(placed.sum()), np.dtype([(name, kind) for name, kind, _ in columns]))
    for axis, name in enumerate("xyz"):
        vertices[name] = positions[placed, axis]
    if counts is not None:
        vertices["count"] = counts[placed]
    if colours is not None:
        for channel, name in enumerate(("red", "green", "blue")):
            vertices[name] = colours[placed, channel]
    properties = [f"property {ply} {name}" for name, _, ply in columns]
    header = ["ply", "format binary_little_endian 1.0", "comment made by protomark export"]
    header += [f"element vertex {len(vertices)}", *properties, "end_header", ""]
    with replacing(output) as file:
        file.write("\n".join(header).encode())
        file.write(vertices.tobytes())
    return {"landmarks": len(vertices), "without_position": int((~placed).sum())}
