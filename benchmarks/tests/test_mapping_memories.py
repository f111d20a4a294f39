"""The descriptor memories that mapping is compared with: one contract for all."""

from __future__ import annotations

import pytest

import protomark as pm
from conftest import random_layers
from mapping_memory import check_changes, check_search, observations
from protomark.mapping.memory import Prototypes
from protomark_bench.mapping.memories import Descriptors, Medoids


@pytest.fixture
def encoder():
    layers = random_layers([256, 32, 16])
    return pm.Encoder(layers, dims=[8, 16], name="tiny", descriptor="orb", scale=0.02)


def memories(encoder):
    return [Prototypes(encoder, 16), Descriptors(32), Medoids(32)]


@pytest.mark.parametrize("which", [0, 1, 2])
def test_each_memory_finds_its_landmarks(encoder, which):
    memory = memories(encoder)[which]
    check_search(memory, squared=isinstance(memory, Prototypes))


@pytest.mark.parametrize("which", [0, 1, 2])
def test_taking_back_merging_and_discarding_leave_what_adding_the_rest_gives(encoder, which):
    check_changes(memories(encoder)[which], memories(encoder)[which])


def test_bytes_that_matching_needs(encoder):
    ids, descriptors = observations(landmarks=12, each=5)
    sizes = []
    for memory in memories(encoder):
        memory.add(ids, memory.encode(descriptors))
        sizes.append(memory.bytes)
    assert sizes == [12 * 17, 12 * 5 * 32, 12 * 32]
