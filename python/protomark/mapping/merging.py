"""Landmarks that turn out to be one."""

from __future__ import annotations

import numpy as np

from protomark.mapping.memory import Memory
from protomark.mapping.structure import Ids, Structure
from protomark.tracks.geometry import refine_points, residuals

# Share of the observations that must fit the joint position.
_FITTING = 0.9


def merge(
    structure: Structure,
    memory: Memory,
    pairs: list[tuple[int, int]],
    max_error: float,
    check: bool = True,
) -> int:
    """Join pairs of landmarks that no frame tells apart and that one position fits.

    The one with more observations stays; its prototype becomes exactly what it would be if all
    observations had been of it.

    Args:
        structure: frames and landmarks.
        memory: what they look like.
        pairs: landmarks that may be one.
        max_error: largest reprojection error, as a share of the image's longer side.
        check: whether the joint position must fit; not while a loop is still open.

    Returns:
        Number of pairs that were joined.
    """
    chosen = _disjoint(structure, pairs)
    if not len(chosen):
        return 0
    fits = ~_seen_together(structure, chosen)
    into, source = chosen[fits].T
    if check and len(into):
        positions, good = _joint(structure, into, source, max_error)
        into, source = into[good], source[good]
        structure.positions[into] = positions[good]
    structure.merge(into, source)
    memory.merge(into, source)
    return len(into)


def _disjoint(structure: Structure, pairs: list[tuple[int, int]]) -> Ids:
    """Each landmark in one pair at most, the one seen more often first."""
    counts, alive = structure.counts(), structure.alive
    taken: set[int] = set()
    out = []
    for a, b in sorted({(min(p), max(p)) for p in pairs}):
        if a != b and alive[a] and alive[b] and a not in taken and b not in taken:
            taken.update((a, b))
            out.append((a, b) if counts[a] >= counts[b] else (b, a))
    return np.array(out, np.int64).reshape(-1, 2)


def _seen_together(structure: Structure, pairs: Ids) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    which = np.full(len(structure.positions), -1)
    which[pairs] = np.arange(len(pairs))[:, None]
    frames, landmarks = structure.pairs()
    pair = which[landmarks]
    # A frame has each landmark once: where a pair is there twice, both are.
    key, count = np.unique((frames * len(pairs) + pair)[pair >= 0], return_counts=True)
    together = np.zeros(len(pairs), bool)
    together[key[count > 1] % len(pairs)] = True
    return together


def _joint(
    structure: Structure, into: Ids, source: Ids, max_error: float
) -> tuple[
    np.ndarray[tuple[int, int], np.dtype[np.float64]], np.ndarray[tuple[int], np.dtype[np.bool_]]
]:
    """Joint positions (n, 3), and whether each fits its observations."""
    place = np.full(len(structure.positions), -1)
    place[into] = place[source] = np.arange(len(into))
    frames, landmarks = structure.pairs(structure.keyframes())
    seen = structure.observations(np.unique(frames[place[landmarks] >= 0]).tolist())
    seen = seen.where(place[seen.landmarks] >= 0)
    which = place[seen.landmarks]
    counts = structure.counts().astype(np.float64)
    weight = (counts[into] / np.maximum(counts[into] + counts[source], 1))[:, None]
    start = weight * structure.positions[into] + (1 - weight) * structure.positions[source]
    joint = refine_points(start, which, seen.poses, seen.rays, seen.focal)
    difference, depth = residuals(joint[which], seen.poses, seen.rays)
    limit = np.array([structure.tolerance(f.camera_id, max_error) for f in structure.frames])
    fine = np.linalg.norm(difference, axis=1) * seen.focal <= limit[seen.frames]
    fine &= depth > 0
    total = np.bincount(which, minlength=len(into))
    share = np.bincount(which, fine, minlength=len(into)) / np.maximum(total, 1)
    return joint, share >= _FITTING
