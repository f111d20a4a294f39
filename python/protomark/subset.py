"""Searches among a subset of a map's landmarks, as if the map held no others."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

import protomark as pm


class Subset:
    """A subset of a map's landmarks, for search alone.

    It returns the same ids, distances and order as a map of these landmarks only. Creating it costs
    time in proportion to the subset, not to the map.

    Args:
        scene: a learning or a sealed map.
        landmark_ids: (n,) int64, the landmarks to search.

    Raises:
        KeyError: an id is not in the map.
    """

    def __init__(self, scene: pm.PrototypeMap | pm.SealedMap, landmark_ids: ArrayLike) -> None:
        ids = np.unique(np.asarray(landmark_ids, np.int64))
        self._several = scene.prototype_count != len(scene)
        if self._several:
            each = [scene.appearances(int(i)) for i in ids]
            means = np.concatenate([*each, np.zeros((0, scene.dim), np.float32)])
            self._max_appearances = max((len(rows) for rows in each), default=1)
            self._landmarks = np.repeat(ids, [len(rows) for rows in each])
            rows = np.arange(len(means))
        else:
            means = scene.prototypes(ids)
            rows = ids
        # A map compares codes with means that are rounded to int8, halves away from zero. Such a
        # rounded mean, added as the only code of a landmark, becomes the same prototype.
        codes = np.trunc(means + np.copysign(np.float32(0.5), means)).astype(np.int8)
        self._map = pm.PrototypeMap(scene.encoder, scene.dim)
        self._map.add_codes(rows, codes)
        self._size = len(ids)

    def __len__(self) -> int:
        return self._size

    def search_codes(
        self, codes: NDArray[np.int8], k: int = 2, threads: int = 1
    ) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """The k nearest landmarks of codes (q, dim), as in `PrototypeMap.search_codes`."""
        if not self._several:
            return self._map.search_codes(codes, k=k, threads=threads)
        # Rows of a landmark are consecutive, so equal distances stay in the order of landmarks.
        rows, distances = self._map.search_codes(
            codes, k=(k - 1) * self._max_appearances + 1, threads=threads
        )
        landmarks = np.append(self._landmarks, -1)[rows]  # row -1 has landmark -1
        ids = np.full((len(codes), k), -1, np.int64)
        found = np.full((len(codes), k), np.iinfo(np.int32).max, np.int32)
        for i, (nearest, distance) in enumerate(zip(landmarks, distances, strict=True)):
            _, first = np.unique(nearest, return_index=True)
            first = np.sort(first[nearest[first] >= 0])[:k]
            ids[i, : len(first)] = nearest[first]
            found[i, : len(first)] = distance[first]
        return ids, found
