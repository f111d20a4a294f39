"""Chooses pairs of keyframes to match, by the overlap of their views.

Consecutive keyframes are matched first. Their matches yield the depth of each view, and depth and
pose the share of one view that another one sees. Among the keyframes with enough overlap each picks
partners: its neighbours in time, the most similar views, and others spread over the whole sequence,
so that every revisit is found.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.colmap import ColmapModel
from protomark.geometry.pose import pose_at, relative_pose
from protomark.geometry.triangulation import depth_of_first
from protomark.tracks.matching import VerifiedMatches, View

MIN_OVERLAP = 0.2
MAX_VIEWING_ANGLE = 50.0  # degrees; binary descriptors do not match across wider angles
MAX_SCALE_CHANGE = 2.0
NEIGHBOURS = (1, 2, 4)
_GRID = 6
_FAR = 1e6


def neighbour_pairs(count: int, starts: int | None = None) -> list[tuple[int, int]]:
    """Pairs of keyframes that are 1, 2 or 4 apart, smaller index first, sorted.

    With `starts`, about so many keyframes, spread over the sequence, come first in a pair.
    """
    at = np.unique(np.linspace(0, count - 1, starts or count).astype(int)).tolist()
    return sorted((i, i + step) for step in NEIGHBOURS for i in at if i + step < count)


def depth_quartiles(
    views: list[View], matches: dict[tuple[int, int], VerifiedMatches]
) -> NDArray[np.float64]:
    """Quartiles (m, 3) of the depths in each keyframe; of all depths if it has too few."""
    seen: list[list[NDArray[np.float64]]] = [[] for _ in views]
    for (i, j), pair in matches.items():
        for a, b, rows in ((i, j, pair.rows), (j, i, pair.rows[:, ::-1])):
            first, second = rows.T
            relative = relative_pose(pose_at(views[a].pose, first), pose_at(views[b].pose, second))
            depth, angle = depth_of_first(*relative, views[a].rays[first], views[b].rays[second])
            seen[a].append(depth[(depth > 0) & (angle > np.radians(0.5))])
    depths = [np.concatenate(d) if d else np.zeros(0) for d in seen]
    everything = np.concatenate(depths) if depths else np.zeros(0)
    fallback = np.percentile(everything, (25, 50, 75)) if len(everything) else np.full(3, _FAR)
    return np.array(
        [np.percentile(d, (25, 50, 75)) if len(d) >= 10 else fallback for d in depths]
    ).reshape(-1, 3)


def overlaps(model: ColmapModel, depths: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share (m, m) of view i that view j sees from a similar angle and distance."""
    m = len(model.names)
    grids, bounds = {}, {}
    for camera_id, camera in model.cameras.items():
        x = (np.arange(_GRID) + 0.5) / _GRID * camera.width
        y = (np.arange(_GRID) + 0.5) / _GRID * camera.height
        grid = camera.rays(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
        grids[camera_id] = grid[np.isfinite(grid).all(1)]
        # The outermost rays of the grid, extended to the image border.
        middle, half = grids[camera_id].mean(0), np.ptp(grids[camera_id], axis=0) / 2
        bounds[camera_id] = np.stack([middle, half * _GRID / (_GRID - 1)])
    rotation, translation = model.cam_from_world[:, :, :3], model.cam_from_world[:, :, 3]
    centers = model.centers
    limit = np.array([bounds[int(c)] for c in model.camera_ids])
    out = np.zeros((m, m))
    for i in range(m):
        grid = grids[int(model.camera_ids[i])]
        local = np.concatenate([np.column_stack([grid, np.ones(len(grid))]) * d for d in depths[i]])
        world = (local - translation[i]) @ rotation[i]
        there = np.einsum("mij,nj->mni", rotation, world) + translation[:, None]
        z = np.maximum(there[:, :, 2], 1e-12)
        inside = (there[:, :, 2] > 0) & (
            np.abs(there[:, :, :2] / z[:, :, None] - limit[:, None, 0]) <= limit[:, None, 1]
        ).all(2)
        ours, theirs = world - centers[i], world[None] - centers[:, None]
        a, b = np.linalg.norm(ours, axis=1), np.linalg.norm(theirs, axis=2)
        b = np.maximum(b, 1e-12)
        cosine = np.einsum("ni,mni->mn", ours, theirs) / (a * b)
        inside &= cosine > np.cos(np.radians(MAX_VIEWING_ANGLE))
        inside &= (b < MAX_SCALE_CHANGE * a) & (a < MAX_SCALE_CHANGE * b)
        out[i] = inside.mean(1)
    np.fill_diagonal(out, 0)
    return out


def covisible_pairs(overlap: NDArray[np.float64], partners: int) -> list[tuple[int, int]]:
    """Pairs of keyframes to match, smaller index first, sorted."""
    m = len(overlap)
    both = np.minimum(overlap, overlap.T)
    chosen = set(neighbour_pairs(m))
    # A pick pairs two keyframes, so each picks about half as many partners as it gets.
    picks = max(1, round(partners * 0.6))
    for i in range(m):
        candidates = np.flatnonzero(both[i] >= MIN_OVERLAP)
        if len(candidates) > picks:
            best = candidates[np.argsort(-both[i, candidates], kind="stable")]
            closest = best[: picks // 3]
            rest = np.sort(best[picks // 3 :])
            at = np.linspace(0, len(rest) - 1, picks - len(closest)).round().astype(int)
            candidates = np.concatenate([closest, rest[at]])
        chosen.update((min(i, int(j)), max(i, int(j))) for j in candidates)
    return sorted(chosen)
