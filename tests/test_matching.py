"""Matches against their definition in NumPy, on all kinds of maps."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import protomark as pm
from protomark.match_calibration import NO_DISTANCE, MatchCalibration, with_calibration
from protomark.matching import MatchList, accept


def reference_probability(
    weights: tuple[float, ...], distances: NDArray[np.int32]
) -> NDArray[np.float64]:
    """The formula of docs/format.md, in Python's floats."""
    result = []
    for nearest, second in distances[:, :2].tolist():
        margin = (second if second < NO_DISTANCE else 4 * nearest) - nearest
        x = weights[0] + weights[1] * nearest + weights[2] * margin
        e = math.exp(-abs(x))
        result.append(0.0 if nearest == NO_DISTANCE else (1.0 if x >= 0 else e) / (1 + e))
    return np.array(result)


def reference_accept(
    nearest: NDArray[np.int64], probabilities: NDArray[np.float64], least: float
) -> MatchList:
    """The likeliest first, ties to the smaller row; each landmark keeps its likeliest keypoint."""
    order = np.argsort(-probabilities, kind="stable")
    order = order[(nearest[order] >= 0) & (probabilities[order] >= least)]
    _, best = np.unique(nearest[order], return_index=True)
    kept = order[np.sort(best)]
    return MatchList(kept, nearest[kept], probabilities[kept])


def assert_equal(found: MatchList, expected: MatchList) -> None:
    for name in ("keypoints", "landmarks", "probabilities"):
        a, b = getattr(found, name), getattr(expected, name)
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


@given(
    st.lists(
        st.tuples(st.integers(-1, 5), st.sampled_from([0, 0.1, 0.3, 0.5, 0.9, 1])), max_size=30
    )
)
def test_accepted_are_as_defined(rows: list[tuple[int, float]]) -> None:
    nearest = np.array([r[0] for r in rows], np.int64)
    probabilities = np.array([r[1] for r in rows], np.float64)
    for least in (0.0, 0.3, 1.0):
        found = accept(nearest, probabilities, least)
        assert_equal(found, reference_accept(nearest, probabilities, least))


def test_probabilities_are_as_defined() -> None:
    rng = np.random.default_rng(0)
    weights = (0.3, -2e-4, 3e-4)
    distances = np.sort(rng.integers(0, 40_000, (500, 3)).astype(np.int32), axis=1)
    distances[:20, 1] = NO_DISTANCE
    distances[:10, 0] = NO_DISTANCE
    found = MatchCalibration(weights).probability(distances)
    np.testing.assert_array_equal(found, reference_probability(weights, distances))
    with pytest.raises(ValueError, match="distances"):
        MatchCalibration(weights).probability(distances[:, :1])


@pytest.mark.parametrize("kind", ["learning", "index", "appearances", "sealed", "words"])
def test_matches_are_as_defined(kind: str, encoder: pm.Encoder, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    # Steep enough that many probabilities are 1, so that rows decide.
    calibration = MatchCalibration((2.0, -0.05, 2.0))
    encoder = with_calibration(encoder, {(12, False): calibration}, "made up")
    ids = rng.permutation(10_000)[:500]
    bits = rng.integers(0, 256, (500, encoder.bits // 8)).astype(np.uint8)
    scene: Any = pm.PrototypeMap(encoder, 12, 4 if kind == "appearances" else 0)
    for _ in range(3):
        noise = np.packbits(rng.random((500, encoder.bits)) < 0.05, axis=1)
        scene.add(ids, bits ^ noise)
    if kind == "index":
        scene.build_index(nlist=8)
    if kind in ("sealed", "words"):
        size = 7 if kind == "words" else None
        scene.seal(tmp_path / "scene.pmk", bytes_per_landmark=size)
        scene = pm.open(tmp_path / "scene.pmk")
    noise = np.packbits(rng.random((1000, encoder.bits)) < 0.05, axis=1)
    queries = np.vstack([bits, bits]) ^ noise

    for among in (None, ids[:50], np.isin(scene.ids, ids[:50])):
        found, distances = scene.search(queries, among=among)
        probabilities = reference_probability(calibration.weights, distances)
        for least in (0.2, 0.7):
            matches = pm.match(scene, queries, min_probability=least, among=among, threads=2)
            assert len(matches) > 10
            assert_equal(matches, reference_accept(found[:, 0], probabilities, least))
    if kind == "index":
        assert_equal(pm.match(scene, queries, recall=1.0), pm.match(scene, queries))
    assert len(pm.match(scene, queries[:0])) == 0
    assert len(pm.match(scene, queries, among=[])) == 0


def test_bad_input(encoder: pm.Encoder) -> None:
    scene = pm.PrototypeMap(encoder)
    frame = np.zeros((1, encoder.bits // 8), np.uint8)
    with pytest.raises(ValueError, match="protomark calibrate"):
        pm.match(scene, frame)
    calibrated = with_calibration(encoder, {(12, False): MatchCalibration((0, 0, 0))}, "made up")
    scene = pm.PrototypeMap(calibrated, 12)
    for least in (-0.1, 1.1, math.nan):
        with pytest.raises(ValueError, match="min_probability must be 0 to 1"):
            pm.match(scene, frame, min_probability=least)
    with pytest.raises(TypeError, match="uint8"):
        pm.match(scene, frame.astype(np.int32))
    with pytest.raises(KeyError):
        pm.match(scene, frame, among=[7])
    with pytest.raises(ValueError, match="mask"):
        pm.match(scene, frame, among=np.zeros(3, bool))
    with pytest.raises(ValueError, match="recall needs an index"):
        pm.match(scene, frame, recall=0.9)
    with pytest.raises(ValueError, match="1 probabilities do not fit 2 landmarks"):
        accept(np.array([1, 2]), np.array([0.5]))
    with pytest.raises(TypeError):
        MatchCalibration((1.0, 2.0))
