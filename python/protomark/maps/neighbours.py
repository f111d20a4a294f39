"""Merges what searches of several maps found, as if they had been one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

NO_DISTANCE = 2**31 - 1  # where there is no neighbour
# Ids (q, k) int64, -1 for none, and squared distances (q, k) int32.
Found = tuple[NDArray[np.int64], NDArray[np.int32]]


def merged(answers: Sequence[Found], k: int, ascending: bool = False) -> Found:
    """The k nearest of several searches for the same queries; ties go to the smaller id.

    Args:
        answers: ids (q, k) and distances (q, k) of each search, of different landmarks.
        k: neighbours to return.
        ascending: whether all ids of an answer are above those of the answers before it.
    """
    if len(answers) == 1:
        return answers[0]
    ids = np.concatenate([one[0] for one in answers], axis=1)
    distances = np.concatenate([one[1] for one in answers], axis=1)
    if ascending:
        order = np.argsort(distances, axis=1, kind="stable")[:, :k]
    else:
        order = np.lexsort((ids, distances), axis=1)[:, :k]
    return np.take_along_axis(ids, order, 1), np.take_along_axis(distances, order, 1)


def accepted(
    ids: NDArray[np.int64],
    distances: NDArray[np.int32],
    k: int,
    max_distance: int | None,
    ratio: float | None,
) -> Found:
    """Neighbours that pass the ratio test and the limit, as in core/src/search/driver.h."""
    if ratio is None:
        return ids, distances
    if not 0 < ratio <= 1:
        raise ValueError("ratio must be above 0 and at most 1")
    passed = (ids[:, 1] < 0) | (distances[:, 0] < ratio * ratio * distances[:, 1])
    keep = np.broadcast_to(passed[:, None], ids.shape)
    if max_distance is not None:
        keep = keep & (distances <= max_distance)
    ids, distances = np.where(keep, ids, -1), np.where(keep, distances, NO_DISTANCE)
    return ids[:, :k], distances[:, :k].astype(np.int32)
