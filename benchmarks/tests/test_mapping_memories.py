"""The descriptor memories that mapping is compared with: one contract for all."""

from __future__ import annotations

import numpy as np
import pytest

import protomark as pm
from conftest import random_layers
from protomark.mapping.memory import Prototypes
from protomark_bench.mapping.memories import Descriptors, Medoids


@pytest.fixture
def encoder():
    layers = random_layers([256, 32, 16])
    return pm.Encoder(layers, dims=[8, 16], name="tiny", descriptor="orb", scale=0.02)


def memories(encoder):
    return [Prototypes(encoder, 16), Descriptors(32), Medoids(32)]


def observations(seed=0, landmarks=12, each=5):
    rng = np.random.default_rng(seed)
    base = rng.integers(0, 256, (landmarks, 32), np.uint8)
    ids = np.repeat(np.arange(1, landmarks + 1), each)
    noise = (rng.random((len(ids), 256)) < 0.05).reshape(len(ids), 32, 8)
    descriptors = base[ids - 1] ^ np.packbits(noise, axis=2)[:, :, 0]
    return ids, descriptors


@pytest.mark.parametrize("which", [0, 1, 2])
def test_each_memory_finds_its_landmarks(encoder, which):
    memory = memories(encoder)[which]
    ids, descriptors = observations()
    encoded = memory.encode(descriptors)
    memory.add(ids[::2], encoded[::2])
    found, distances = memory.search(encoded[1::2])
    assert (found[:, 0] == ids[1::2]).mean() > 0.9
    assert (distances[:, 0] <= distances[:, 1]).all()
    rows = np.arange(len(found))
    again = memory.distances(encoded[1::2], rows, found[:, 0])
    squared = again**2 if isinstance(memory, Prototypes) else again
    np.testing.assert_allclose(squared, distances[:, 0], rtol=1e-5)


@pytest.mark.parametrize("which", [0, 1, 2])
def test_taking_back_merging_and_discarding_leave_what_adding_the_rest_gives(encoder, which):
    memory, rest = memories(encoder)[which], memories(encoder)[which]
    ids, descriptors = observations()
    encoded = memory.encode(descriptors)
    memory.add(ids, encoded)
    removed = np.zeros(len(ids), bool)
    removed[[0, 7, 8, 21, 40]] = True
    memory.subtract(ids[removed], encoded[removed])
    memory.merge_landmarks(np.array([3, 5]), np.array([4, 6]))
    memory.remove(np.array([1, 9]))
    np.testing.assert_array_equal(memory.contains(np.array([1, 2, 3, 4, 9])), [0, 1, 1, 0, 0])
    ids = np.where(ids == 4, 3, np.where(ids == 6, 5, ids))
    stays = ~removed & (ids != 1) & (ids != 9)
    rest.add(ids[stays], encoded[stays])
    for a, b in zip(memory.search(encoded), rest.search(encoded), strict=True):
        np.testing.assert_array_equal(a, b)
    assert memory.bytes == rest.bytes


def test_bytes_that_matching_needs(encoder):
    ids, descriptors = observations(landmarks=12, each=5)
    sizes = []
    for memory in memories(encoder):
        memory.add(ids, memory.encode(descriptors))
        sizes.append(memory.bytes)
    assert sizes == [12 * 17, 12 * 5 * 32, 12 * 32]
