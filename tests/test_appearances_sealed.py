"""Sealing several prototypes per landmark: merged by cost, searched exactly."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import protomark as pm
from appearances import Reference, appearances_of, assert_search, observations
from conftest import balanced_encoder, random_descriptors, rounded
from map_container import container, sections
from sealing import in_words, quantized


@pytest.fixture(scope="module")
def encoder() -> pm.Encoder:
    made = balanced_encoder()
    assert len(set(appearances_of(made.encode(random_descriptors(31)), 12))) == 31
    return made


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("appearances")


def test_search_across_chunks(encoder: pm.Encoder, folder: Path) -> None:
    """A map larger than the search's chunks, with landmarks across their borders."""
    rng = np.random.default_rng(0)
    scene = pm.PrototypeMap(encoder, appearance_bits=6)
    codes = rng.integers(-127, 128, (6000, 12)).astype(np.int8)
    scene.add_codes(rng.integers(0, 700, 6000), codes)
    queries = rng.integers(-127, 128, (40, 12)).astype(np.int8)
    assert scene.prototype_count > 3000
    assert_search(scene, queries, k=3)
    for size, kept in ((None, scene.prototype_count), (in_words(scene, 4.3), 700 * 43 // 10)):
        scene.seal(folder / "large.pmk", bytes_per_landmark=size, tune=False)
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
    size = in_words(scene, prototypes)
    sealed = scene.seal(folder / "w.pmk", bytes_per_landmark=size, tune=False)
    pm.verify_file(folder / "w.pmk")
    known = reference.ids()
    n, m = len(known), len(reference.rows)
    # 12 numbers take 12 bytes, or 6 as words.
    lossless = 12 * m + (1 if m > n else 0) * n <= size * n
    assert (sealed.dim, sealed.words) == (12, 0 if lossless else 6)
    expected = merged_rows(reference, m if lossless else int(prototypes * n))
    np.testing.assert_array_equal(sealed.ids, known)
    assert sealed.prototype_count == sum(map(len, expected.values()))
    means = {i: rounded(np.array([s / c for s, c in expected[i]])) for i in known}
    for i in known:
        exact = means[i] if lossless else quantized(means[i], encoder.codebooks[1])
        np.testing.assert_array_equal(sealed.appearances(i), exact)


def test_bytes_per_landmark(encoder: pm.Encoder, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    scene = pm.PrototypeMap(encoder, appearance_bits=8)
    codes = rng.integers(-127, 128, (8000, 12)).astype(np.int8)
    scene.add_codes(np.arange(8000) % 1600, codes)
    path = tmp_path / "s.pmk"
    # Sealed to one prototype per landmark, the file is one without appearances.
    scene.seal(path, bytes_per_landmark=6, tune=False)
    sizes = dict(pm.file_sections(path))
    assert set(sizes) == {"encoder", "shape", "width", "protos"}
    plain = pm.PrototypeMap(encoder)
    plain.add_codes(np.arange(8000) % 1600, codes)
    plain.seal(tmp_path / "plain.pmk", bytes_per_landmark=6)
    assert path.read_bytes() == (tmp_path / "plain.pmk").read_bytes()

    sealed = scene.seal(path, bytes_per_landmark=2 * 6 + 1)
    sizes = dict(pm.file_sections(path))
    assert set(sizes) == {"encoder", "shape", "rows", "width", "protos"}
    assert sealed.prototype_count == 3200
    assert sizes["rows"] + sizes["protos"] == 1600 * (2 * 6 + 1)


def test_a_landmark_with_very_many_appearances(encoder: pm.Encoder, tmp_path: Path) -> None:
    """A sealed landmark has at most 255 prototypes."""
    rng = np.random.default_rng(3)
    scene = pm.PrototypeMap(encoder, appearance_bits=12)
    scene.add_codes([5] * 900 + [6], rng.integers(-127, 128, (901, 12)).astype(np.int8))
    rows = scene.prototype_count
    assert len(scene.appearances(5)) == rows - 1 > 300
    assert scene.counts([5, 6]).tolist() == [900, 1]
    for size in (None, 1e9, 12 * 128 + 1, 12 * 128, 6 * 128 + 1):
        sealed = scene.seal(tmp_path / "s.pmk", bytes_per_landmark=size)
        assert (len(sealed.appearances(5)), sealed.prototype_count) == (255, 256)
        assert sealed.words == (6 if size in (12 * 128, 6 * 128 + 1) else 0)
    sealed = scene.seal(tmp_path / "s.pmk", bytes_per_landmark=6 * 50 + 1)
    assert (len(sealed.appearances(5)), len(sealed.appearances(6))) == (99, 1)


@pytest.mark.parametrize("kind", ["int8", "words"])
@pytest.mark.parametrize(
    ("section", "content", "message"),
    [
        ("rows", bytes([2, 0, 3]), "it has a landmark without prototypes"),
        ("rows", bytes([2, 1]), "section 'rows' has the wrong size"),
        ("rows", bytes([255, 255, 255]), "section 'protos' has the wrong size"),
        ("rows", None, None),
        ("protos", b"", "section 'protos' has the wrong size"),
    ],
)
def test_hostile_sealed_maps_are_refused(
    kind: str,
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
    scene.seal(path, bytes_per_landmark=in_words(scene) if kind == "words" else None)
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
