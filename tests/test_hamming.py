from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import protomark as pm
from conftest import NO_DISTANCE, random_descriptors


def reference(
    queries: Any, database: Any, k: int, landmarks: Any, limit: int
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Reference search: sorts all rows by distance and id."""
    ids = np.full((len(queries), k), -1, np.int64)
    distances = np.full((len(queries), k), NO_DISTANCE, np.int32)
    for q, query in enumerate(queries):
        nearest: dict[int, int] = {}
        for landmark, row in zip(landmarks, database, strict=True):
            d = int(np.unpackbits(query ^ row).sum())
            nearest[landmark] = min(d, nearest.get(landmark, d))
        best = sorted((d, i) for i, d in nearest.items() if d <= limit)[:k]
        for j, (d, i) in enumerate(best):
            ids[q, j], distances[q, j] = i, d
    return ids, distances


@settings(max_examples=60, deadline=None)
@given(
    size=st.sampled_from([1, 7, 8, 32, 61, 64, 128]),
    rows=st.integers(0, 70),
    k=st.integers(1, 5),
    distinct=st.booleans(),
    limit=st.none() | st.integers(0, 300),
    alphabet=st.sampled_from([2, 256]),
    seed=st.integers(0, 2**32 - 1),
)
def test_equals_sorting(
    size: int, rows: int, k: int, distinct: bool, limit: int | None, alphabet: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    queries = rng.integers(0, alphabet, (5, size), dtype=np.uint8)
    database = rng.integers(0, alphabet, (rows, size), dtype=np.uint8)
    landmarks = rng.integers(0, max(1, rows // 2), rows) if distinct else np.arange(rows)
    ids, distances = pm.hamming_search(
        queries, database, k, landmarks=landmarks if distinct else None, max_distance=limit
    )
    expected = reference(queries, database, k, landmarks, 8 * size if limit is None else limit)
    np.testing.assert_array_equal(ids, expected[0])
    np.testing.assert_array_equal(distances, expected[1])


def test_large_database_on_threads() -> None:
    """The rows cross the borders of the search's chunks."""
    queries, database = random_descriptors(200, 256, 1), random_descriptors(5000, 256, 2)
    expected = np.bitwise_count(queries[:, None] ^ database[None]).sum(-1, dtype=np.int64)
    order = np.argsort(expected, axis=1, kind="stable")[:, :2]
    for threads in (1, 3):
        ids, distances = pm.hamming_search(queries, database, threads=threads)
        np.testing.assert_array_equal(ids, order)
        np.testing.assert_array_equal(distances, np.take_along_axis(expected, order, 1))


def test_wrong_input_is_named() -> None:
    a = np.zeros((2, 8), np.uint8)
    with pytest.raises(ValueError, match="queries have 8 bytes, the database has 9"):
        pm.hamming_search(a, np.zeros((2, 9), np.uint8))
    with pytest.raises(ValueError, match="k must be at least 1"):
        pm.hamming_search(a, a, k=0)
    with pytest.raises(ValueError, match="database has 2 rows, landmarks has 3"):
        pm.hamming_search(a, a, landmarks=[1, 2, 3])
    with pytest.raises(ValueError, match="must not be negative"):
        pm.hamming_search(a, a, landmarks=[1, -1])
    with pytest.raises(TypeError, match=r"landmark ids: a \(n,\) int64 array is needed"):
        pm.hamming_search(a, a, landmarks=[1.5, 2.0])
