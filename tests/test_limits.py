"""Limits that docs/limits.md states, in Python; core/tests/test_limits.cpp has the others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import protomark as pm
from conftest import NO_DISTANCE, random_descriptors


@pytest.fixture
def scene(encoder: pm.Encoder) -> pm.PrototypeMap:
    scene = pm.PrototypeMap(encoder)
    scene.add([0, 2**63 - 1], random_descriptors(2))
    return scene


def test_the_largest_id(scene: pm.PrototypeMap) -> None:
    assert scene.ids.tolist() == [0, 2**63 - 1]
    assert scene.search(random_descriptors(2), k=1)[0][:, 0].tolist() == [0, 2**63 - 1]
    assert scene.counts(np.array([2**63 - 1], np.uint64)) == [1]


@pytest.mark.parametrize("ids", [[-1, 1], [1, -(2**63)], np.array([1, 2**63], np.uint64)])
def test_ids_outside(scene: pm.PrototypeMap, ids: Any) -> None:
    with pytest.raises(ValueError, match=r"is negative|is above 2\*\*63 - 1"):
        scene.add(ids, random_descriptors(2))
    with pytest.raises((KeyError, ValueError), match=r"is not in the map|is above 2\*\*63 - 1"):
        scene.counts(ids)
    assert len(scene) == 2


@pytest.mark.parametrize("ids", [[0.0, 1.0], [True, False], ["0", "1"], [[0, 1]], [None, 1]])
def test_ids_that_are_no_integers(scene: pm.PrototypeMap, ids: Any) -> None:
    with pytest.raises(TypeError, match="landmark ids"):
        scene.add(ids, random_descriptors(2))


@pytest.mark.parametrize("k", [2**60, 2**63, 2**64 - 1])
def test_more_neighbours_than_memory(scene: pm.PrototypeMap, k: int) -> None:
    for n in (1, 2, 3):
        with pytest.raises(MemoryError):
            scene.search(random_descriptors(n), k=k)
        with pytest.raises(MemoryError):
            pm.hamming_search(random_descriptors(n), random_descriptors(5), k=k)


def test_more_neighbours_than_landmarks(scene: pm.PrototypeMap) -> None:
    ids, distances = scene.search(random_descriptors(2), k=100)
    assert (ids[:, 2:] == -1).all()
    assert (distances[:, 2:] == NO_DISTANCE).all()
    with pytest.raises(ValueError, match="k must be at least 1"):
        scene.search(random_descriptors(2), k=0)


@pytest.mark.parametrize("position", [[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, -np.inf]])
def test_positions_are_finite(scene: pm.PrototypeMap, position: list[float]) -> None:
    with pytest.raises(ValueError, match="position of landmark 0 is not finite"):
        scene.set_positions([0], [position])
    assert np.isnan(scene.positions([0])).all()


@pytest.mark.parametrize("shape", [(2, 2), (3,), (2, 3, 1)])
def test_positions_have_three_numbers(scene: pm.PrototypeMap, shape: tuple[int, ...]) -> None:
    with pytest.raises(TypeError, match="positions"):
        scene.set_positions([0, 2**63 - 1], np.zeros(shape))
