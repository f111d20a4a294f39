"""What every memory of descriptors must do that the mapper may be given."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def observations(
    seed: int = 0, landmarks: int = 12, each: int = 5
) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    rng = np.random.default_rng(seed)
    base = rng.integers(0, 256, (landmarks, 32), np.uint8)
    ids = np.repeat(np.arange(1, landmarks + 1), each)
    noise = (rng.random((len(ids), 256)) < 0.05).reshape(len(ids), 32, 8)
    descriptors = base[ids - 1] ^ np.packbits(noise, axis=2)[:, :, 0]
    return ids, descriptors


def check_search(memory: Any, squared: bool) -> None:
    """Landmarks are found; `squared` tells whether search squares the distances."""
    ids, descriptors = observations()
    encoded = memory.encode(descriptors)
    memory.add(ids[::2], encoded[::2])
    found, distances = memory.search(encoded[1::2])
    assert (found[:, 0] == ids[1::2]).mean() > 0.9
    assert (distances[:, 0] <= distances[:, 1]).all()
    rows = np.arange(len(found))
    again = memory.distances(encoded[1::2], rows, found[:, 0])
    np.testing.assert_allclose(again**2 if squared else again, distances[:, 0], rtol=1e-5)


def check_changes(memory: Any, rest: Any) -> None:
    """Taking back, merging and discarding leave what adding the rest gives, in two new memories."""
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
