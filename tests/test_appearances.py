"""Several prototypes per landmark: exact after any change, searched exactly."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import protomark as pm
from appearances import (
    Reference,
    appearance_bits,
    appearances_of,
    assert_equals,
    assert_search,
    file_bytes,
    observations,
)
from conftest import balanced_encoder, random_descriptors, rounded
from map_container import LEARNING_MAP, container, sections
from sealing import in_words


@pytest.fixture(scope="module")
def encoder() -> pm.Encoder:
    made = balanced_encoder()
    assert len(set(appearances_of(made.encode(random_descriptors(31)), 12))) == 31
    return made


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("appearances")


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
    fewer = scene.seal(folder / "s.pmk", bytes_per_landmark=in_words(scene, 1.5))
    assert_search(fewer, queries, **options)


def test_maps_without_appearances(encoder: pm.Encoder, tmp_path: Path) -> None:
    descriptors, ids = random_descriptors(300), np.arange(300) % 40
    scene = pm.PrototypeMap(encoder, appearance_bits=0)
    scene.add(ids, descriptors)
    data = file_bytes(scene, tmp_path)
    assert data[8:12] == (1).to_bytes(4, "little")
    assert {name for name, _ in sections(data)} == {"encoder", "shape", "counts", "spare", "sums"}
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
            "bytes_per_landmark must be at least 2 for this map",
            lambda: scene.seal(tmp_path / "s.pmk", bytes_per_landmark=1.9),
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
    sealed = scene.seal(tmp_path / "s.pmk", bytes_per_landmark=in_words(scene, 3))
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
        ("spare", bytes(8), "section 'sums' has the wrong size"),
        ("spare", None, "it lacks the section 'spare'"),
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


def test_every_flipped_byte_is_noticed(encoder: pm.Encoder, tmp_path: Path) -> None:
    scene = pm.PrototypeMap(encoder, appearance_bits=4)
    scene.add(np.arange(90) % 20, random_descriptors(90))
    paths = [tmp_path / "o.pmk", tmp_path / "s.pmk"]
    scene.save(paths[0])
    scene.seal(paths[1], bytes_per_landmark=in_words(scene, 2))
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
    sealed = scene.seal(tmp_path / "s.pmk", bytes_per_landmark=2.5 * 6 + 2)
    np.save(tmp_path / "d.npy", descriptors)
    script = (
        "import sys, numpy as np, protomark as pm\n"
        "folder = sys.argv[1]\n"
        "d = np.load(folder + '/d.npy')\n"
        "scene = pm.PrototypeMap(pm.open(folder + '/o.pmk').encoder, appearance_bits=7)\n"
        "scene.add(np.arange(5000) % 600, d)\n"
        "scene.save(folder + '/o2.pmk')\n"
        "sealed = scene.seal(folder + '/s2.pmk', bytes_per_landmark=17)\n"
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
