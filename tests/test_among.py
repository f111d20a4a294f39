"""Search among a subset of landmarks, compared with a map of only these."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import protomark as pm
from conftest import NO_DISTANCE, balanced_encoder, random_descriptors
from sealing import in_words

LANDMARKS = 300


def observed(appearance_bits: int) -> pm.PrototypeMap:
    rng = np.random.default_rng(appearance_bits)
    scene = pm.PrototypeMap(balanced_encoder(), appearance_bits=appearance_bits)
    scene.add(3 * rng.integers(0, LANDMARKS, 2000), random_descriptors(2000, seed=1))
    return scene


def filtered(
    scene: pm.PrototypeMap | pm.SealedMap, ids: NDArray[np.int64], codes: NDArray[np.int8], k: int
) -> tuple[list[list[int]], list[list[int]]]:
    """The k nearest of all landmarks that are in `ids`."""
    every, distances = scene.search_codes(codes, k=len(scene))
    found, away = [], []
    for row, distance in zip(every, distances, strict=True):
        kept = np.isin(row, ids)
        found.append([*row[kept], *[-1] * k][:k])
        away.append([*distance[kept].tolist(), *[NO_DISTANCE] * k][:k])
    return found, away


@pytest.mark.parametrize(
    "kind",
    [
        "learning",
        "int8",
        "words",
        "appearances",
        "sealed appearances",
        "appearances, words",
        "index",
    ],
)
@pytest.mark.parametrize("size", [0, 1, 2, 40, 250])
def test_equals_the_answers_of_the_whole_map_without_the_others(
    kind: str, size: int, tmp_path: Path
) -> None:
    scene: pm.PrototypeMap | pm.SealedMap = observed(4 if "appearances" in kind else 0)
    assert isinstance(scene, pm.PrototypeMap)
    if kind == "index":
        scene.build_index(5)
    if kind not in ("learning", "appearances"):
        smaller = in_words(scene) if "words" in kind else None
        scene = scene.seal(tmp_path / "s.pmk", bytes_per_landmark=smaller)
    rng = np.random.default_rng(size)
    ids = rng.choice(scene.ids, size, replace=False)
    codes = scene.encoder.encode(random_descriptors(60, seed=2))
    for k in (1, 2, 3):
        expected, away = filtered(scene, ids, codes, k)
        for among in (ids, np.repeat(ids, 2), np.isin(scene.ids, ids)):
            found, distances = scene.search_codes(codes, k=k, among=among, threads=2)
            assert found.tolist() == expected
            assert distances.tolist() == away
    if kind == "index":
        everywhere = scene.search_codes(codes, k=3, among=ids, nprobe=scene.nlist)
        assert everywhere[0].tolist() == expected
        near = scene.search_codes(codes, k=3, among=ids, nprobe=1)[0]
        assert np.isin(near, [-1, *ids]).all()


def test_the_ratio_test_is_among_the_same_landmarks() -> None:
    scene = observed(0)
    ids = scene.ids[::7]
    codes = scene.encoder.encode(random_descriptors(60, seed=2))
    (nearest, second), ratio = np.sqrt(scene.search_codes(codes, among=ids)[1].T), 0.9
    found, _ = scene.search_codes(codes, among=ids, ratio=ratio)
    assert ((found[:, 0] >= 0) == (nearest < ratio * second)).all()


def test_what_does_not_fit_is_named() -> None:
    scene = observed(0)
    codes = np.zeros((1, scene.dim), np.int8)
    with pytest.raises(KeyError, match="1"):
        scene.search_codes(codes, among=[3, 1])
    with pytest.raises(ValueError, match=f"mask of 2 landmarks does not fit a map of {len(scene)}"):
        scene.search_codes(codes, among=[True, False])
