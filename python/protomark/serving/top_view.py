"""A map from above, for the page that shows where a photo was taken."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.geometry.pose import camera_centers, ground_plane
from protomark.maps.places import Place
from protomark.maps.sharded_map import ShardedMap

MAX_LANDMARKS = 20_000
# The plane of the widest spread, whatever this share of stray points does.
_STRAY = 0.03


def top_view(
    scene: pm.PrototypeMap | pm.SealedMap | ShardedMap,
    places: Sequence[Place],
    poses: NDArray[np.float64] | None,
) -> list[dict[str, Any]]:
    """Each place of a map as JSON values: its plane, and landmarks and cameras in that.

    Args:
        scene: the map; of its landmarks at most `MAX_LANDMARKS` are drawn.
        places: its places; none if it is one.
        poses: (n, 3, 4) the keyframes of a map of one place; None: unknown.
    """
    step = 1 + len(scene) // MAX_LANDMARKS
    ids = scene.every(step) if isinstance(scene, ShardedMap) else scene.ids[::step]
    parts = [(p.name, ids[p.holds(ids)]) for p in places] or [("", ids)]
    return [_view(name, scene.positions(part), poses) for name, part in parts]


def _view(
    name: str, positions: NDArray[np.float64], poses: NDArray[np.float64] | None
) -> dict[str, Any]:
    positions = positions[np.isfinite(positions).all(axis=1)]
    origin = np.median(positions, axis=0) if len(positions) else np.zeros(3)
    offsets = positions - origin
    if poses is not None:
        plane, path = ground_plane(poses), camera_centers(poses) - origin
    else:
        plane, path = _widest_plane(offsets), np.zeros((0, 3))
    return {
        "name": name,
        "origin": origin.tolist(),
        "plane": plane.tolist(),
        "landmarks": _rounded(offsets @ plane.T),
        "keyframes": _rounded(path @ plane.T),
    }


def _widest_plane(offsets: NDArray[np.float64]) -> NDArray[np.float64]:
    distance = np.linalg.norm(offsets, axis=1)
    near = offsets[distance <= np.quantile(distance, 1 - _STRAY)] if len(offsets) else offsets
    if len(near) < 3:
        return np.eye(3)[:2]
    return np.linalg.svd(near, full_matrices=False)[2][:2]


def _rounded(points: NDArray[np.float64]) -> list[list[float]]:
    """Points (n, 2) as short decimals: a picture has some thousand pixels."""
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    digits = int(np.clip(4 - np.floor(np.log10(extent)), 0, 9)) if extent > 0 else 3
    return points.round(digits).tolist()


def keyframe_poses(path: Path) -> NDArray[np.float64] | None:
    """Poses (n, 3, 4) of the keyframes in a folder of `protomark map`; None if there are none."""
    if not path.is_dir():
        return None
    from protomark.geometry.colmap import find_model, read_model

    with suppress(OSError, ValueError):
        poses = read_model(find_model(path)).cam_from_world
        return poses if len(poses) else None
    return None
