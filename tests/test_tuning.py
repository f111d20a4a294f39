"""Prototypes that are tuned when a map is sealed, compared with the definition in NumPy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import protomark as pm
from conftest import random_codebooks, random_descriptors, random_layers

DIM = 16


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("tuned")


@pytest.fixture(scope="module")
def coder() -> pm.Encoder:
    return pm.Encoder(
        random_layers([64, 40, DIM]),
        [DIM],
        name="t",
        descriptor="test",
        scale=0.02,
        codebooks=random_codebooks((DIM // 2, 2)),
    )


def observed(landmarks: int, seed: int) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """One to eight observations of each landmark, alike enough to be mistaken."""
    rng = np.random.default_rng(seed)
    ids = np.repeat(
        rng.choice(10 * landmarks, landmarks, replace=False), rng.integers(1, 9, landmarks)
    )
    kinds = random_descriptors(max(landmarks // 3, 1), 64, seed)
    _, of_landmark = np.unique(ids, return_inverse=True)
    noise = np.packbits(rng.random((len(ids), 64)) < 0.15, axis=1)
    return ids, kinds[of_landmark % len(kinds)] ^ noise


def exponential(i: int) -> int:
    value = 1 << 30
    for _ in range(i):
        value = value * 4228380000 >> 32
        if value < 1 << 10:
            return 0
    return value


def model(
    prototypes: NDArray[np.int64], counts: Any, queries: NDArray[np.int64], own: Any
) -> NDArray[np.int64]:
    """`tune_prototypes` of core/src/map/sealed_store.h for one prototype per landmark."""
    rest = counts[own] - 1
    difference = queries - prototypes[own]
    usable = np.flatnonzero(rest > 0)
    total = int((difference**2).sum(1)[usable].sum())
    temperature = max(total // max(4 * len(usable), 1), 1)
    numbers = prototypes * 16

    def own_distance(q: int) -> int:
        now = queries[q] * 16 - numbers[own[q]]
        s = 1 / float(rest[q])
        both = float((now * difference[q]).sum()) / 16
        return int(float((now**2).sum()) / 256 + 2 * s * both + s * s * (difference[q] ** 2).sum())

    for _ in range(3):
        rounded = np.sign(numbers) * ((2 * abs(numbers) + 16) // 32)
        rivals = {}
        for q in usable:
            distances = ((queries[q] - rounded) ** 2).sum(1)
            nearest = np.argsort(distances, kind="stable")[:16]
            limit = own_distance(q) + 8 * temperature
            rivals[q] = [r for r in nearest if r != own[q] and distances[r] <= limit]
        usable = np.array([q for q in usable if rivals[q]], dtype=np.int64)
        for _ in range(4):
            sums = np.zeros_like(numbers)
            for q in usable:
                away = [((queries[q] * 16 - numbers[r]) ** 2).sum() >> 8 for r in rivals[q]]
                distances = [own_distance(q), *map(int, away)]
                terms = [exponential((d - min(distances)) * 64 // temperature) for d in distances]
                pushes = [t * 32768 // sum(terms) for t in terms[1:]]
                for r, push in zip(rivals[q], pushes, strict=True):
                    sums[r] -= push * (queries[q] * 16 - numbers[r])
                sums[own[q]] += sum(pushes) * (queries[q] * 16 - numbers[own[q]])
            step = 0.35 / ((counts + 2.0) * 32768.0)
            moved = np.clip(numbers + step[:, None] * sums, -127 * 16, 127 * 16)
            numbers = np.where(sums.any(1)[:, None], np.floor(moved + 0.5), numbers).astype(
                np.int64
            )
    return np.sign(numbers) * ((2 * abs(numbers) + 16) // 32)


@settings(max_examples=12)
@given(landmarks=st.integers(1, 40), seed=st.integers(0, 2**32 - 1), threads=st.integers(1, 3))
def test_prototypes_equal_the_definition(
    folder: Path, coder: pm.Encoder, landmarks: int, seed: int, threads: int
) -> None:
    ids, descriptors = observed(landmarks, seed)
    scene = pm.PrototypeMap(coder)
    scene.add(ids, descriptors)
    tuned = scene.seal(
        folder / "a.pmk", ids, descriptors, bytes_per_landmark=DIM + 1, threads=threads
    )
    means = scene.seal(folder / "b.pmk").prototypes(scene.ids).astype(np.int64)
    queries = coder.encode(descriptors).astype(np.int64)
    expected = model(means, scene.counts(scene.ids), queries, np.searchsorted(scene.ids, ids))
    np.testing.assert_array_equal(tuned.prototypes(scene.ids), expected)


def test_any_order_of_equal_observations_gives_equal_files(folder: Path, coder: pm.Encoder) -> None:
    ids, descriptors = observed(300, 0)
    files = []
    for seed in (1, 2):
        order = np.random.default_rng(seed).permutation(len(ids))
        scene = pm.PrototypeMap(coder, appearance_bits=4)
        scene.add(ids[order], descriptors[order])
        foreign = np.full(5, 10**6)  # observations of landmarks that the map does not hold
        for given_ids, given_descriptors in (
            (None, None),
            (np.append(ids[order], foreign), np.vstack([descriptors[order], descriptors[:5]])),
        ):
            path = folder / f"{seed}.pmk"
            scene.seal(path, given_ids, given_descriptors, bytes_per_landmark=9, threads=seed)
            files.append(path.read_bytes())
    assert files[0] == files[2]
    assert files[1] == files[3]
    scene.seal(path, bytes_per_landmark=9, tune=False)
    assert len({files[0], files[1], path.read_bytes()}) == 3


def test_a_seal_leaves_the_map_as_it_was(folder: Path, coder: pm.Encoder) -> None:
    ids, descriptors = observed(100, 3)
    scene = pm.PrototypeMap(coder)
    scene.add(ids, descriptors)
    path = folder / "journal.pmk"
    scene.save(path)
    with pm.open(path, journal=True) as learning:
        learning.seal(folder / "sealed.pmk", ids, descriptors, bytes_per_landmark=DIM + 1)
        assert learning.commit() == 0
        learning.save(folder / "again.pmk")
    assert (folder / "again.pmk").read_bytes() == path.read_bytes()


def test_an_index_finds_what_prototypes_are_mistaken_for(folder: Path, coder: pm.Encoder) -> None:
    """Tuning with an index, whose search is approximate, answers like tuning without one."""
    ids, descriptors = observed(2000, 4)
    scene = pm.PrototypeMap(coder)
    scene.add(ids, descriptors)
    right = []
    for nlist, tune in ((None, False), (None, True), (8, True)):
        if nlist:
            scene.build_index(nlist=nlist)
        sealed = scene.seal(
            folder / "c.pmk", ids, descriptors, bytes_per_landmark=DIM + 1, tune=tune
        )
        found, _ = sealed.search(descriptors, k=1)
        right.append(int((found[:, 0] == ids).sum()))
    assert right[1] == right[2]  # sixteen lists are all of them
    assert right[1] > right[0]


def test_observations_are_checked(folder: Path, coder: pm.Encoder) -> None:
    ids, descriptors = observed(10, 5)
    scene = pm.PrototypeMap(coder)
    scene.add(ids, descriptors)
    path = folder / "none.pmk"
    with pytest.raises(ValueError, match="come together"):
        scene.seal(path, ids, bytes_per_landmark=DIM + 1)
    with pytest.raises(ValueError, match="landmark ids for"):
        scene.seal(path, ids[1:], descriptors, bytes_per_landmark=DIM + 1)
    with pytest.raises(ValueError, match="bytes"):
        scene.seal(path, ids, descriptors[:, 1:].copy(), bytes_per_landmark=DIM + 1)
    assert not path.exists()


def test_codes_tune_as_their_descriptors_do(folder: Path, coder: pm.Encoder) -> None:
    ids, descriptors = observed(100, 3)
    scene = pm.PrototypeMap(coder)
    scene.add(ids, descriptors)
    scene.seal(folder / "a.pmk", ids, descriptors, bytes_per_landmark=DIM + 1)
    codes = coder.encode(descriptors)
    scene.seal(folder / "b.pmk", ids, codes, bytes_per_landmark=DIM + 1)
    assert (folder / "a.pmk").read_bytes() == (folder / "b.pmk").read_bytes()
    with pytest.raises(ValueError, match=f"codes have {DIM - 1} dimensions, the map has {DIM}"):
        scene.seal(folder / "b.pmk", ids, codes[:, 1:], bytes_per_landmark=DIM + 1)
    codes[0, 0] = -128
    with pytest.raises(ValueError, match="codes must be -127 to 127"):
        scene.seal(folder / "b.pmk", ids, codes, bytes_per_landmark=DIM + 1)


def test_untuned_maps_have_room_for_second_prototypes(folder: Path) -> None:
    rng = np.random.default_rng(0)
    encoder = pm.Encoder.load("freak")
    ids = np.repeat(np.arange(400), 4)
    descriptors = rng.integers(0, 256, (1600, encoder.bits // 8), np.uint8)
    scene = pm.PrototypeMap(encoder, appearance_bits=5)
    scene.add(ids, descriptors)
    found = {}
    for size in (17, 25, 33, 49):
        for by, tuners in ((None, None), (ids, descriptors)):
            sealed = scene.seal(folder / "s.pmk", by, tuners, bytes_per_landmark=size)
            assert sealed.bytes_per_landmark <= size
            found[size, by is not None] = (sealed.dim, sealed.words)
            several = sealed.prototype_count / len(sealed)
            assert (several >= 1.25) == (size > 33 or (size > 17 and by is None))
    assert [found[n, False] for n in (17, 25, 33, 49)] == [(51, 17), (57, 19), (50, 25), (64, 32)]
    assert [found[n, True] for n in (17, 25, 33, 49)] == [(51, 17), (50, 25), (64, 32), (64, 32)]
