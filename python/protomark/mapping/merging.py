"""Merges duplicate landmarks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.triangulation import pixel_errors, refine_points
from protomark.mapping.frame import Ids
from protomark.mapping.memory import Memory
from protomark.mapping.structure import Structure

# This share of the observations must fit the joint position.
_FITTING = 0.9


def merge_duplicates(
    structure: Structure,
    memory: Memory,
    pairs: list[tuple[int, int]],
    check: bool = True,  # whether one position must fit; not before a loop is closed
) -> int:
    """Merge pairs of landmarks that no frame observes together and that one position fits.

    Returns their number.

    The landmark with more observations stays, and its prototype is exactly that of all observations
    together.
    """
    chosen = _disjoint(structure, pairs)
    if not len(chosen):
        return 0
    fits = ~_observed_together(structure, chosen)
    into, source = chosen[fits].T
    if check and len(into):
        positions, good = _joint_positions(structure, into, source)
        into, source = into[good], source[good]
        structure.positions[into] = positions[good]
    structure.merge(into, source)
    memory.merge_landmarks(into, source)
    return len(into)


def _disjoint(structure: Structure, pairs: list[tuple[int, int]]) -> Ids:
    """Pairs (n, 2) without a landmark in common, the one with more observations first."""
    counts, existing = structure.counts(), structure.existing
    used: set[int] = set()
    chosen = []
    for a, b in sorted({(min(p), max(p)) for p in pairs}):
        if a != b and existing[a] and existing[b] and a not in used and b not in used:
            used.update((a, b))
            chosen.append((a, b) if counts[a] >= counts[b] else (b, a))
    return np.array(chosen, np.int64).reshape(-1, 2)


def _observed_together(structure: Structure, pairs: Ids) -> NDArray[np.bool_]:
    """Whether some frame observes both landmarks of each pair (n, 2)."""
    which = np.full(len(structure.positions), -1)
    which[pairs] = np.arange(len(pairs))[:, None]
    frames, landmarks = structure.pairs()
    pair = which[landmarks]
    # A frame observes each landmark once, so a pair that occurs twice is observed together.
    key, count = np.unique((frames * len(pairs) + pair)[pair >= 0], return_counts=True)
    together = np.zeros(len(pairs), bool)
    together[key[count > 1] % len(pairs)] = True
    return together


def _joint_positions(
    structure: Structure, into: Ids, source: Ids
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Joint positions (n, 3), and whether each fits its observations."""
    number = np.full(len(structure.positions), -1)
    number[into] = number[source] = np.arange(len(into))
    frames, landmarks = structure.pairs(structure.keyframes())
    seen = structure.observations(np.unique(frames[number[landmarks] >= 0]).tolist())
    seen = seen.where(number[seen.landmarks] >= 0)
    which = number[seen.landmarks]
    counts = structure.counts().astype(np.float64)
    weight = (counts[into] / np.maximum(counts[into] + counts[source], 1))[:, None]
    start = weight * structure.positions[into] + (1 - weight) * structure.positions[source]
    joint = refine_points(start, which, seen.poses, seen.rays, seen.focal)
    errors = pixel_errors(joint[which], seen.poses, seen.rays, seen.focal)
    limit = np.array([structure.max_error(f.camera_id) for f in structure.frames])
    fits = errors <= limit[seen.frames]
    total = np.bincount(which, minlength=len(into))
    share = np.bincount(which, fits, minlength=len(into)) / np.maximum(total, 1)
    return joint, share >= _FITTING
