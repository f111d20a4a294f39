"""Several prototypes per landmark: exact after any change, searched exactly, merged by cost."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import protomark as pm
from conftest import NO_DISTANCE, balanced_encoder, random_descriptors, rounded
from map_container import LEARNING_MAP, container, sections
from sealing import best_scale, four_bits, quantized

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


@pytest.fixture(scope="module")
def encoder() -> pm.Encoder:
    made = balanced_encoder()
    assert len(set(appearances_of(made.encode(random_descriptors(31)), 12))) == 31
    return made


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("appearances")


observations = st.lists(st.tuples(st.integers(0, 12), st.integers(0, 30)), max_size=80)
appearance_bits = st.sampled_from([1, 2, 5, 12])


@settings(max_examples=60, deadline=None)
@given(
    observed=observations,
    bits=appearance_bits,
    order=st.randoms(),
    cuts=st.lists(st.integers(0, 80), max_size=4),
)
def test_any_order_and_any_batches_give_the_same_bytes(
    observed: list[tuple[int, int]],
    bits: int,
    order: Any,
    cuts: list[int],
    encoder: pm.Encoder,
    folder: Path,
) -> None:
    pool = random_descriptors(31)
    ids = np.array([i for i, _ in observed], np.int64)
    descriptors = pool[[d for _, d in observed]]
    at_once = pm.PrototypeMap(encoder, appearance_bits=bits)
    at_once.add(ids, descriptors, threads=2)
    reference = Reference(bits)
    reference.add(ids, encoder.encode(descriptors))
    assert at_once.appearance_bits == bits
    assert_equals(at_once, reference)

    rows = list(range(len(ids)))
    order.shuffle(rows)
    piecewise = pm.PrototypeMap(encoder, appearance_bits=bits)
    for part in np.split(np.array(rows, np.int64), sorted(c for c in cuts if c < len(rows))):
        piecewise.add(ids[part], descriptors[part])
    assert file_bytes(piecewise, folder) == file_bytes(at_once, folder)

    # Built in two places and merged.
    here, there = (pm.PrototypeMap(encoder, appearance_bits=bits) for _ in range(2))
    here.add(ids[::2], descriptors[::2])
    there.add(ids[1::2], descriptors[1::2])
    here.merge_map(there)
    assert file_bytes(here, folder) == file_bytes(at_once, folder)

    read = pm.open(folder / "scene.pmk")
    assert isinstance(read, pm.PrototypeMap)
    assert read.appearance_bits == bits
    assert_equals(read, reference)


@settings(max_examples=60, deadline=None)
@given(bits=appearance_bits, steps=st.lists(st.tuples(st.sampled_from("aaardm"), observations)))
def test_any_history_of_changes(
    bits: int, steps: list[tuple[str, list[tuple[int, int]]]], encoder: pm.Encoder, folder: Path
) -> None:
    """After additions and removals the map equals one built from the remaining observations."""
    pool = random_descriptors(31)
    codes = encoder.encode(pool)
    scene, reference = pm.PrototypeMap(encoder, appearance_bits=bits), Reference(bits)
    there: list[tuple[int, int]] = []
    for kind, observed in steps:
        if kind == "a":
            ids, rows = [i for i, _ in observed], [d for _, d in observed]
            scene.add(ids, pool[rows])
            reference.add(ids, codes[rows])
            there += observed
        elif kind == "r":
            gone, there = there[::2], there[1::2]
            scene.subtract([i for i, _ in gone], pool[[d for _, d in gone]])
            reference.subtract([i for i, _ in gone], codes[[d for _, d in gone]])
        elif kind == "d":
            known = reference.ids()[: len(observed)]
            scene.remove(known)
            for i in known:
                reference.remove(i)
            there = [(i, d) for i, d in there if i not in known]
        else:
            pairs = list(zip(reference.ids()[::2], reference.ids()[1::2], strict=False))
            scene.merge_landmarks([a for a, _ in pairs], [b for _, b in pairs])
            for a, b in pairs:
                reference.merge_landmarks(a, b)
            new_id = {b: a for a, b in pairs}
            there = [(new_id.get(i, i), d) for i, d in there]
        # Nothing is halved with so few observations of one appearance.
        assert all(n < 255 for _, n in reference.rows.values())
        assert_equals(scene, reference)
    fresh = pm.PrototypeMap(encoder, appearance_bits=bits)
    fresh.add([i for i, _ in there], pool[[d for _, d in there]])
    assert file_bytes(scene, folder) == file_bytes(fresh, folder)


def test_each_appearance_is_halved_at_255(encoder: pm.Encoder) -> None:
    rng = np.random.default_rng(0)
    codes = rng.integers(-127, 128, (900, 12)).astype(np.int8)
    ids = np.full(900, 3)
    scene, reference = pm.PrototypeMap(encoder, appearance_bits=1), Reference(1)
    for begin in range(0, 900, 50):
        scene.add_codes(ids[begin : begin + 50], codes[begin : begin + 50])
        reference.add(ids[begin : begin + 50], codes[begin : begin + 50])
        assert_equals(scene, reference)
    assert scene.appearance_counts(3).dtype == np.uint32
    assert scene.counts([3]).dtype == np.uint32
    assert scene.counts([3])[0] > 255
    other = pm.PrototypeMap(encoder, appearance_bits=1)
    other.add_codes([4] * 200, np.full((200, 12), 7, np.int8))
    before = scene.appearance_counts(3)
    scene.merge_map(other)
    scene.merge_landmarks(3, 4)
    n = int(before[1]) + 200
    np.testing.assert_array_equal(scene.appearance_counts(3), [before[0], n // 2 if n > 255 else n])


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


@settings(max_examples=50, deadline=None)
@given(
    n=st.integers(0, 90),
    landmarks=st.integers(1, 30),
    bits=appearance_bits,
    values=st.integers(1, 127),
    k=st.integers(1, 4),
    max_distance=st.none() | st.integers(0, 90_000),
    ratio=st.none() | st.floats(0.25, 1),
    seed=st.integers(0, 2**32 - 1),
)
def test_search_equals_sorting(
    n: int,
    landmarks: int,
    bits: int,
    values: int,
    k: int,
    max_distance: int | None,
    ratio: float | None,
    seed: int,
    encoder: pm.Encoder,
    folder: Path,
) -> None:
    rng = np.random.default_rng(seed)
    scene = pm.PrototypeMap(encoder, appearance_bits=bits)
    ids = rng.integers(0, landmarks, n) * 3
    scene.add_codes(ids, rng.integers(-values, values + 1, (n, 12)).astype(np.int8))
    scene.remove(scene.ids[:3])
    queries = rng.integers(-values, values + 1, (9, 12)).astype(np.int8)
    options = {"k": k, "max_distance": max_distance, "ratio": ratio}
    assert_search(scene, queries, **options)
    sealed = scene.seal(folder / "s.pmk")
    assert sealed.prototype_count == scene.prototype_count
    for i in scene.ids:
        np.testing.assert_array_equal(sealed.appearances(i), rounded(scene.appearances(i)))
    for a, b in zip(
        sealed.search_codes(queries, **options),
        scene.search_codes(queries, **options),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)
    fewer = scene.seal(folder / "s.pmk", bytes_per_landmark=four_bits(scene, 1.5))
    assert_search(fewer, queries, **options)


def test_search_across_chunks(encoder: pm.Encoder, folder: Path) -> None:
    """A map larger than the search's chunks, with landmarks across their borders."""
    rng = np.random.default_rng(0)
    scene = pm.PrototypeMap(encoder, appearance_bits=6)
    codes = rng.integers(-127, 128, (6000, 12)).astype(np.int8)
    scene.add_codes(rng.integers(0, 700, 6000), codes)
    queries = rng.integers(-127, 128, (40, 12)).astype(np.int8)
    assert scene.prototype_count > 3000
    assert_search(scene, queries, k=3)
    for size, kept in ((None, scene.prototype_count), (four_bits(scene, 4.3), 700 * 43 // 10)):
        scene.seal(folder / "large.pmk", bytes_per_landmark=size)
        sealed = pm.open(folder / "large.pmk")
        assert f"{kept} prototypes" in repr(sealed)
        assert_search(sealed, queries, k=3)
        means = np.array([sealed.appearances(i).mean(axis=0) for i in range(700)])
        np.testing.assert_allclose(sealed.prototypes(range(700)), means, rtol=1e-6, atol=1e-6)


def merged_rows(reference: Reference, limit: int) -> dict[int, list[tuple[NDArray[np.int64], int]]]:
    """Plain greedy merging over the whole map, every pair compared at every step."""
    rows = {i: [reference.rows[key] for key in reference.of(i)] for i in reference.ids()}

    def cost(a: tuple[NDArray[np.int64], int], b: tuple[NDArray[np.int64], int]) -> float:
        (s, n), (t, m) = a, b
        return int(((m * s - n * t) ** 2).sum()) / (n * m * (n + m))

    while sum(map(len, rows.values())) > limit:
        pairs = [
            (cost(own[a], own[b]), i, a, b)
            for i, own in rows.items()
            for a, b in combinations(range(len(own)), 2)
        ]
        if not pairs:
            break
        _, i, a, b = min(pairs)
        (s, n), (t, m) = rows[i][a], rows[i].pop(b)
        rows[i][a] = s + t, n + m
    return rows


@settings(max_examples=60, deadline=None)
@given(
    observed=observations,
    bits=st.sampled_from([0, 1, 3, 12]),
    prototypes=st.floats(1, 6),
    values=st.sampled_from([1, 2, 127]),
    seed=st.integers(0, 2**32 - 1),
)
def test_sealing_equals_plain_merging(
    observed: list[tuple[int, int]],
    bits: int,
    prototypes: float,
    values: int,
    seed: int,
    encoder: pm.Encoder,
    folder: Path,
) -> None:
    """Small values make many costs equal, so that the order of rows decides."""
    pool = np.random.default_rng(seed).integers(-values, values + 1, (31, 12)).astype(np.int8)
    ids, rows = [i for i, _ in observed], [d for _, d in observed]
    scene, reference = pm.PrototypeMap(encoder, appearance_bits=bits), Reference(bits)
    scene.add_codes(ids, pool[rows])
    reference.add(ids, pool[rows])
    size = four_bits(scene, prototypes)
    sealed = scene.seal(folder / "w.pmk", bytes_per_landmark=size)
    pm.verify_file(folder / "w.pmk")
    known = reference.ids()
    n, m = len(known), len(reference.rows)
    # 12 numbers take 12 bytes or, of 4 bits, 8.
    lossless = 12 * m + (2 if m > n else 1) * n <= size * n
    assert sealed.code_bits == (8 if lossless else 4)
    expected = merged_rows(reference, m if lossless else int(prototypes * n))
    np.testing.assert_array_equal(sealed.ids, known)
    assert sealed.prototype_count == sum(map(len, expected.values()))
    means = {i: rounded(np.array([s / c for s, c in expected[i]])) for i in known}
    scale = best_scale(np.concatenate(list(means.values()))) if not lossless else 0
    for i in known:
        exact = means[i] if lossless else quantized(means[i], scale)
        np.testing.assert_array_equal(sealed.appearances(i), exact)
        assert sealed.counts([i])[0] == sum(c for _, c in expected[i])


def test_bytes_per_landmark(encoder: pm.Encoder, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    scene = pm.PrototypeMap(encoder, appearance_bits=8)
    codes = rng.integers(-127, 128, (8000, 12)).astype(np.int8)
    scene.add_codes(np.arange(8000) % 1600, codes)
    path = tmp_path / "s.pmk"
    # Sealed to one prototype per landmark, the file is one without appearances.
    scene.seal(path, bytes_per_landmark=9)
    sizes = dict(pm.file_sections(path))
    assert set(sizes) == {"encoder", "shape", "counts", "sq4scale", "protos"}
    plain = pm.PrototypeMap(encoder)
    plain.add_codes(np.arange(8000) % 1600, codes)
    plain.seal(tmp_path / "plain.pmk", bytes_per_landmark=9)
    assert path.read_bytes() == (tmp_path / "plain.pmk").read_bytes()

    sealed = scene.seal(path, bytes_per_landmark=2 * 8 + 2)
    sizes = dict(pm.file_sections(path))
    assert set(sizes) == {"encoder", "shape", "counts", "rows", "sq4scale", "protos"}
    assert sealed.prototype_count == 3200
    assert sizes["counts"] + sizes["rows"] + sizes["protos"] == 1600 * (2 * 8 + 2)


def test_a_landmark_with_very_many_appearances(encoder: pm.Encoder, tmp_path: Path) -> None:
    """A sealed landmark has at most 255 prototypes, and a count of at most 255."""
    rng = np.random.default_rng(3)
    scene = pm.PrototypeMap(encoder, appearance_bits=12)
    scene.add_codes([5] * 900 + [6], rng.integers(-127, 128, (901, 12)).astype(np.int8))
    rows = scene.prototype_count
    assert len(scene.appearances(5)) == rows - 1 > 300
    assert scene.counts([5, 6]).tolist() == [900, 1]
    for size in (None, 1e9, 12 * 128 + 2, 12 * 128 + 1, 8 * 128 + 2):
        sealed = scene.seal(tmp_path / "s.pmk", bytes_per_landmark=size)
        assert (len(sealed.appearances(5)), sealed.prototype_count) == (255, 256)
        assert sealed.code_bits == (4 if size in (12 * 128 + 1, 8 * 128 + 2) else 8)
        assert sealed.counts([5, 6]).tolist() == [255, 1]
    sealed = scene.seal(tmp_path / "s.pmk", bytes_per_landmark=8 * 50 + 2)
    assert (len(sealed.appearances(5)), len(sealed.appearances(6))) == (99, 1)


def test_maps_without_appearances(encoder: pm.Encoder, tmp_path: Path) -> None:
    descriptors, ids = random_descriptors(300), np.arange(300) % 40
    scene = pm.PrototypeMap(encoder, appearance_bits=0)
    scene.add(ids, descriptors)
    data = file_bytes(scene, tmp_path)
    assert data[8:12] == (1).to_bytes(4, "little")
    assert {name for name, _ in sections(data)} == {"encoder", "shape", "counts", "sums"}
    assert scene.counts([0]).dtype == np.uint32
    assert scene.prototype_count == len(scene) == 40
    assert scene.appearance_bits == 0
    np.testing.assert_array_equal(scene.appearances(3), scene.prototypes([3]))
    np.testing.assert_array_equal(scene.appearance_counts(3), scene.counts([3]))


def test_wrong_calls_change_nothing(encoder: pm.Encoder, tmp_path: Path) -> None:
    scene = pm.PrototypeMap(encoder, appearance_bits=12)
    codes = np.array([[5] * 12, [5] * 12, [-5] * 12], np.int8)
    scene.add_codes([1, 2, 2], codes)
    before = file_bytes(scene, tmp_path)
    calls: list[tuple[type[Exception], str, Any]] = [
        (
            ValueError,
            "appearance_bits must be 0 to 12, not 13",
            lambda: pm.PrototypeMap(encoder, 12, 13),
        ),
        (
            ValueError,
            "appearance_bits must be 0 to 5, not 6",
            lambda: pm.PrototypeMap(encoder, 5, 6),
        ),
        (ValueError, "were never added", lambda: scene.subtract_codes([2, 1], codes[1:])),
        (
            ValueError,
            "1 observations of one appearance, 2",
            lambda: scene.subtract_codes([2, 2], codes[:2]),
        ),
        (KeyError, "landmark 9 is not", lambda: scene.subtract_codes([1, 9], codes[:2])),
        (KeyError, "landmark 9 is not in the map", lambda: scene.appearances(9)),
        (KeyError, "landmark 9 is not in the map", lambda: scene.appearance_counts(9)),
        (
            ValueError,
            "maps of 12 and 3 appearance bits",
            lambda: scene.merge_map(pm.PrototypeMap(encoder, appearance_bits=3)),
        ),
        (
            ValueError,
            "bytes_per_landmark must be at least 9 for this map",
            lambda: scene.seal(tmp_path / "s.pmk", bytes_per_landmark=8.9),
        ),
    ]
    for error, message, call in calls:
        with pytest.raises(error, match=message):
            call()
        assert file_bytes(scene, tmp_path) == before
    assert not (tmp_path / "s.pmk").exists()


def test_positions_are_the_landmarks(encoder: pm.Encoder, tmp_path: Path) -> None:
    scene = pm.PrototypeMap(encoder, appearance_bits=12)
    scene.add(np.arange(60) % 6, random_descriptors(60))
    scene.set_positions([4, 5], np.array([[1.0, 2, 3], [4, 5, 6]]))
    scene.merge_landmarks(1, 5)
    scene.remove([0])
    file_bytes(scene, tmp_path)
    sealed = scene.seal(tmp_path / "s.pmk", bytes_per_landmark=four_bits(scene, 3))
    for m in (scene, pm.open(tmp_path / "scene.pmk"), sealed):
        np.testing.assert_array_equal(m.positions([1, 4]), [[4, 5, 6], [1, 2, 3]])
        assert np.isnan(m.positions([2, 3])).all()


def words(*values: int) -> bytes:
    return np.array(values, "<u4").tobytes()


def marked(*appearances: int) -> bytes:
    """Appearances of 3 bits, plus 8 for the last row of a landmark."""
    return sum(a << 4 * i for i, a in enumerate(appearances)).to_bytes(8, "little")


@pytest.mark.parametrize(
    ("section", "content", "message"),
    [
        ("appbits", words(0), "its appearances have 0 bits, not 1 to 12"),
        ("appbits", words(13), "its appearances have 13 bits, not 1 to 12"),
        ("appbits", words(2**32 - 1), "its appearances have 4294967295 bits"),
        ("appbits", words(3, 0), "section 'appbits' is longer than it should be"),
        ("appbits", words(2), "it has prototypes of no landmark"),
        ("appbits", None, "section 'counts' is longer than it should be"),
        ("appear", marked(5, 15, 13), None),
        ("appear", marked(5, 13, 13), "the appearances of landmark 4 do not ascend"),
        ("appear", marked(7, 13, 13), "the appearances of landmark 4 do not ascend"),
        ("appear", marked(13, 7, 15), "the appearances of landmark 8 do not ascend"),
        ("appear", marked(13, 15, 13), "it has prototypes of no landmark"),
        ("appear", marked(4, 5, 15), "it has a landmark without prototypes"),
        ("appear", b"", "section 'appear' has the wrong size"),
        ("appear", None, "it lacks the section 'appear'"),
        ("counts", bytes([1, 0, 1]), "it has an impossible prototype"),
        ("counts", bytes([1, 1, 0]), "it has an impossible prototype"),
        ("counts", bytes([1]), "section 'counts' has the wrong size"),
        ("counts", bytes([1, 1]), "section 'sums' has the wrong size"),
        ("idblocks", struct.pack("<qQ", -1, 2), "negative landmark id"),
        ("idgaps", (1).to_bytes(8, "little"), "landmark ids do not ascend"),
    ],
)
def test_hostile_learning_maps_are_refused(
    section: str, content: bytes | None, message: str | None, encoder: pm.Encoder, tmp_path: Path
) -> None:
    """Two landmarks, 4 with appearances 5 and 7, 8 with appearance 5."""
    scene = pm.PrototypeMap(encoder, appearance_bits=3)
    codes = np.full((3, 12), 9, np.int8)
    codes[[0, 2], 1] = -9
    scene.add_codes([4, 4, 8], codes)
    parts = sections(file_bytes(scene, tmp_path))
    path = tmp_path / "scene.pmk"
    assert container(parts, kind=LEARNING_MAP) == path.read_bytes()
    changed = [(name, content if name == section else old) for name, old in parts]
    path.write_bytes(container([(n, c) for n, c in changed if c is not None], kind=LEARNING_MAP))
    if message is None:
        assert_search(pm.open(path), codes)
        return
    with pytest.raises(pm.FileError, match=message):
        pm.open(path)


@pytest.mark.parametrize("bits", [8, 4])
@pytest.mark.parametrize(
    ("section", "content", "message"),
    [
        ("rows", bytes([2, 0, 3]), "it has a landmark without prototypes"),
        ("rows", bytes([2, 1]), "section 'rows' has the wrong size"),
        ("rows", bytes([255, 255, 255]), "section 'protos' has the wrong size"),
        ("rows", None, None),
        ("counts", bytes(2), "section 'counts' has the wrong size"),
        ("protos", b"", "section 'protos' has the wrong size"),
    ],
)
def test_hostile_sealed_maps_are_refused(
    bits: int,
    section: str,
    content: bytes | None,
    message: str | None,
    encoder: pm.Encoder,
    tmp_path: Path,
) -> None:
    scene = pm.PrototypeMap(encoder, appearance_bits=3)
    codes = np.full((5, 12), 9, np.int8)
    codes[[0, 2], 1] = -9
    scene.add_codes([4, 4, 8, 9, 9], codes)
    scene.merge_landmarks(9, 8)
    scene.add_codes([8], codes[:1])
    path = tmp_path / "s.pmk"
    scene.seal(path, bytes_per_landmark=four_bits(scene) if bits == 4 else None)
    assert scene.prototype_count == 5
    parts = sections(path.read_bytes())
    assert container(parts) == path.read_bytes()
    changed = [(name, content if name == section else old) for name, old in parts]
    path.unlink()
    path.write_bytes(container([(n, c) for n, c in changed if c is not None]))
    if message is None:
        # Five prototypes of three landmarks: what is left over is padding, which nobody reads.
        assert len(pm.open(path).appearances(9)) == 1
        return
    with pytest.raises(pm.FileError, match=message):
        pm.open(path)


def test_every_flipped_byte_is_noticed(encoder: pm.Encoder, tmp_path: Path) -> None:
    scene = pm.PrototypeMap(encoder, appearance_bits=4)
    scene.add(np.arange(90) % 20, random_descriptors(90))
    paths = [tmp_path / "o.pmk", tmp_path / "s.pmk"]
    scene.save(paths[0])
    scene.seal(paths[1], bytes_per_landmark=four_bits(scene, 2))
    rng = np.random.default_rng(5)
    for path in paths:
        data = path.read_bytes()
        ends = [data.rfind(content) + len(content) for _, content in sections(data)]
        for at in [*range(288), *rng.integers(max(ends) - 3000, max(ends), 300)]:
            flipped = bytearray(data)
            flipped[at] ^= int(rng.integers(1, 256))
            path.unlink()
            path.write_bytes(flipped)
            # What no checksum covers, or nobody has checked, must still never crash.
            try:
                pm.open(path).search(random_descriptors(1))
                pm.verify_file(path)
            except pm.FileError:
                continue
            assert sections(bytes(flipped)) == sections(data)


def test_plain_code_gives_the_same_file_and_answers(encoder: pm.Encoder, tmp_path: Path) -> None:
    """Each process chooses its instruction set at the start, so another one runs the plain code."""
    scene = pm.PrototypeMap(encoder, appearance_bits=7)
    descriptors = random_descriptors(5000)
    scene.add(np.arange(5000) % 600, descriptors)
    scene.save(tmp_path / "o.pmk")
    sealed = scene.seal(tmp_path / "s.pmk", bytes_per_landmark=2.5 * 8 + 2)
    np.save(tmp_path / "d.npy", descriptors)
    script = (
        "import sys, numpy as np, protomark as pm\n"
        "folder = sys.argv[1]\n"
        "d = np.load(folder + '/d.npy')\n"
        "scene = pm.PrototypeMap(pm.open(folder + '/o.pmk').encoder, appearance_bits=7)\n"
        "scene.add(np.arange(5000) % 600, d)\n"
        "scene.save(folder + '/o2.pmk')\n"
        "sealed = scene.seal(folder + '/s2.pmk', bytes_per_landmark=22)\n"
        "maps = {'learning': scene, 'sealed': sealed}\n"
        "found = {n: np.column_stack(m.search(d[:70], k=5)) for n, m in maps.items()}\n"
        "np.savez(folder + '/r.npz', **found)\n"
    )
    subprocess.run(
        [sys.executable, "-c", script, str(tmp_path)],
        env={**os.environ, "PROTOMARK_ISA": "portable"},
        check=True,
    )
    for name in ("o", "s"):
        plain = (tmp_path / f"{name}2.pmk").read_bytes()
        assert plain == (tmp_path / f"{name}.pmk").read_bytes()
    answers: Any = np.load(tmp_path / "r.npz")
    for name, m in {"learning": scene, "sealed": sealed}.items():
        np.testing.assert_array_equal(answers[name], np.column_stack(m.search(descriptors[:70], 5)))
