"""Search among a subset of landmarks, compared with a map of only these."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import protomark as pm
from conftest import NO_DISTANCE, balanced_encoder, random_descriptors
from protomark.subset import Subset
from sealing import four_bits

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
    "kind", ["learning", "8", "4", "appearances", "sealed appearances", "appearances 4", "index"]
)
@pytest.mark.parametrize("size", [0, 1, 2, 40])
def test_equals_the_answers_of_the_whole_map_without_the_others(
    kind: str, size: int, tmp_path: Path
) -> None:
    scene: pm.PrototypeMap | pm.SealedMap = observed(4 if "appearances" in kind else 0)
    assert isinstance(scene, pm.PrototypeMap)
    if kind == "index":
        scene.build_index(5)
    if kind not in ("learning", "appearances"):
        smaller = four_bits(scene) if "4" in kind else None
        scene = scene.seal(tmp_path / "s.pmk", bytes_per_landmark=smaller)
    rng = np.random.default_rng(size)
    ids = rng.choice(scene.ids, size, replace=False)
    codes = scene.encoder.encode(random_descriptors(60, seed=2))
    for k in (1, 2, 3):
        found, distances = Subset(scene, ids).search_codes(codes, k=k)
        expected, away = filtered(scene, ids, codes, k)
        assert found.tolist() == expected
        assert distances.tolist() == away


def test_unknown_landmarks_are_named() -> None:
    with pytest.raises(KeyError, match="1"):
        Subset(observed(0), [3, 1])
