"""Maps with several prototypes per landmark: their definition, and what tests of them share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

import protomark as pm
from conftest import NO_DISTANCE, rounded

Key = tuple[int, int]


def appearances_of(codes: NDArray[np.int8], bits: int) -> list[int]:
    return [sum(int(code[j] > 0) << j for j in range(bits)) for code in codes]


class Reference:
    """A sum and a count for each appearance of each landmark, halved at 255."""

    def __init__(self, bits: int) -> None:
        self.bits = bits
        self.rows: dict[Key, tuple[NDArray[np.int64], int]] = {}

    def add(self, ids: Any, codes: NDArray[np.int8]) -> None:
        for key, code in zip(self.keys(ids, codes), codes.astype(np.int64), strict=True):
            total, n = self.rows.get(key, (0 * code, 0))
            if n == 255:
                total, n = np.trunc(total / 2).astype(np.int64), 127
            self.rows[key] = total + code, n + 1

    def subtract(self, ids: Any, codes: NDArray[np.int8]) -> None:
        for key, code in zip(self.keys(ids, codes), codes.astype(np.int64), strict=True):
            total, n = self.rows.pop(key)
            if n > 1:
                self.rows[key] = total - code, n - 1

    def merge_landmarks(self, into: int, source: int) -> None:
        for _, appearance in self.of(source):
            total, n = self.rows.pop((source, appearance))
            old, m = self.rows.get((into, appearance), (0 * total, 0))
            self.rows[into, appearance] = total + old, n + m

    def remove(self, landmark: int) -> None:
        for key in self.of(landmark):
            del self.rows[key]

    def keys(self, ids: Any, codes: NDArray[np.int8]) -> list[Key]:
        return [
            (int(i), appearance)
            for i, appearance in zip(ids, appearances_of(codes, self.bits), strict=True)
        ]

    def of(self, landmark: int) -> list[Key]:
        return sorted(key for key in self.rows if key[0] == landmark)

    def ids(self) -> list[int]:
        return sorted({i for i, _ in self.rows})

    def means(self, landmark: int) -> NDArray[np.float64]:
        return np.array([self.rows[key][0] / self.rows[key][1] for key in self.of(landmark)])


def assert_equals(scene: pm.PrototypeMap, reference: Reference) -> None:
    ids = reference.ids()
    assert len(scene) == len(ids)
    assert scene.prototype_count == len(reference.rows)
    np.testing.assert_array_equal(scene.ids, ids)
    for i in ids:
        rows = [reference.rows[key] for key in reference.of(i)]
        np.testing.assert_array_equal(scene.appearances(i), reference.means(i).astype(np.float32))
        np.testing.assert_array_equal(scene.appearance_counts(i), [n for _, n in rows])
        total, n = sum(s for s, _ in rows), sum(n for _, n in rows)
        assert scene.counts([i]) == [n]
        np.testing.assert_array_equal(scene.prototypes([i])[0], (total / n).astype(np.float32))


def file_bytes(scene: pm.PrototypeMap, folder: Path) -> bytes:
    scene.save(folder / "scene.pmk")
    return (folder / "scene.pmk").read_bytes()


def expected_answers(
    landmarks: dict[int, NDArray[np.int64]],
    query: NDArray[np.int64],
    k: int,
    max_distance: int | None,
    ratio: float | None,
) -> list[tuple[int, int]]:
    """The definition: a landmark's distance is that of its nearest prototype."""
    every = sorted((int(((p - query) ** 2).sum(1).min()), i) for i, p in landmarks.items())
    clear = len(every) < 2 or ratio is None or every[0][0] < ratio * ratio * every[1][0]
    every = every if clear else []
    limit = NO_DISTANCE if max_distance is None else max_distance
    best = [(i, squared) for squared, i in every[:k] if squared <= limit]
    return best + [(-1, NO_DISTANCE)] * (k - len(best))


def assert_search(
    scene: pm.PrototypeMap | pm.SealedMap, queries: NDArray[np.int8], **options: Any
) -> None:
    ids, distances = scene.search_codes(queries, threads=2, **options)
    landmarks = {int(i): rounded(scene.appearances(i)) for i in scene.ids}
    options = {"k": 2, "max_distance": None, "ratio": None} | options
    for q, query in enumerate(queries.astype(np.int64)):
        best = expected_answers(landmarks, query, **options)
        np.testing.assert_array_equal(ids[q], [i for i, _ in best])
        np.testing.assert_array_equal(distances[q], [s for _, s in best])


observations = st.lists(st.tuples(st.integers(0, 12), st.integers(0, 30)), max_size=80)
appearance_bits = st.sampled_from([1, 2, 5, 12])
