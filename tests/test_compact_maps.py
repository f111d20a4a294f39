"""Sealed maps of words of codebooks, compared with docs/format.md in NumPy."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import protomark as pm
from conftest import (
    NO_DISTANCE,
    random_codebooks,
    random_descriptors,
    random_layers,
    rounded,
)
from map_container import container, sections
from sealing import decoded, quantized


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sealed")


# Words of 1 to 4 numbers, of codes around the 4 numbers that are packed together, and longer ones.
CODEBOOKS = {width: random_codebooks((24 // width, width))[0] for width in (1, 2, 3, 4)}
SHAPES = [
    *((dim, 1) for dim in (1, 2, 3, 6, 9, 21)),
    *((dim, 2) for dim in (2, 4, 6, 12, 24)),
    *((dim, 3) for dim in (3, 6, 9, 21, 24)),
    *((dim, 4) for dim in (4, 12, 24)),
]


@pytest.fixture(scope="module")
def plain() -> pm.Encoder:
    dims = sorted({dim for dim, _ in SHAPES})
    return pm.Encoder(random_layers([64, 40, 24]), dims, name="t", descriptor="test", scale=0.02)


@pytest.fixture(scope="module")
def coders(plain: pm.Encoder) -> dict[int, pm.Encoder]:
    """Encoders with a codebook of each width."""
    return {width: plain.with_codebooks([CODEBOOKS[width]]) for width in CODEBOOKS}


@pytest.fixture(scope="module")
def coder(plain: pm.Encoder) -> pm.Encoder:
    """An encoder with codebooks of two and three numbers."""
    return plain.with_codebooks([CODEBOOKS[2], CODEBOOKS[3]])


def filled(coder: pm.Encoder, dim: int, n: int, limit: int, seed: int) -> pm.PrototypeMap:
    """A map whose prototypes reach up to `limit`; its landmarks have two appearances."""
    rng = np.random.default_rng(seed)
    scene = pm.PrototypeMap(coder, dim=dim, appearance_bits=1)
    ids = rng.choice(1000, n, replace=False)
    for sign in (1, -1):
        codes = rng.integers(-limit, limit + 1, (n, dim)).astype(np.int8)
        codes[:, 0] = sign * np.maximum(abs(codes[:, 0]), 1)
        scene.add_codes(ids, codes)
    return scene


def read_numbers(path: Path, m: int, k: int) -> NDArray[np.int64]:
    """Reads the prototypes of a file by docs/format.md."""
    found = dict(sections(path.read_bytes()))
    width = int.from_bytes(found["width"], "little")
    m16 = -(-m // 16) * 16
    words = np.frombuffer(found["protos"], np.uint8).reshape(m16 // 16, k // width, 16)
    words = words.transpose(0, 2, 1).reshape(m16, k // width)
    assert not words[m:].any()
    return decoded(words[:m], CODEBOOKS[width])


@settings(max_examples=60, deadline=None)
@given(
    n=st.integers(1, 40),
    k=st.integers(1, 4),
    shape=st.sampled_from(SHAPES),
    limit=st.integers(0, 127),
    max_distance=st.none() | st.integers(0, 90_000),
    ratio=st.none() | st.floats(0.25, 1),
    threads=st.integers(1, 3),
    seed=st.integers(0, 2**32 - 1),
)
def test_words_and_search_equal_the_definition(
    n: int,
    k: int,
    shape: tuple[int, int],
    limit: int,
    max_distance: int | None,
    ratio: float | None,
    threads: int,
    seed: int,
    coders: dict[int, pm.Encoder],
    folder: Path,
) -> None:
    dim, width = shape
    scene = filled(coders[width], dim, n, limit, seed)
    sealed = scene.seal(folder / "s.pmk", bytes_per_landmark=dim // width, tune=False)
    pm.verify_file(folder / "s.pmk")
    means = rounded(scene.prototypes(scene.ids))
    expected = quantized(means, CODEBOOKS[width])
    np.testing.assert_array_equal(read_numbers(folder / "s.pmk", n, dim), expected)
    np.testing.assert_array_equal(sealed.prototypes(scene.ids), expected)
    np.testing.assert_array_equal(sealed.ids, scene.ids)
    assert (len(sealed), sealed.dim, sealed.words) == (n, dim, dim // width)

    queries = np.random.default_rng(seed).integers(-128, 128, (35, dim)).astype(np.int8)
    ids, distances = sealed.search_codes(
        queries, k=k, max_distance=max_distance, ratio=ratio, threads=threads
    )
    for q, query in enumerate(queries.astype(np.int64)):
        squared = ((expected - query) ** 2).sum(1)
        order = np.argsort(squared, kind="stable")
        keep = True
        if ratio is not None and len(order) > 1:
            keep = float(squared[order[0]]) < ratio * ratio * float(squared[order[1]])
        furthest = NO_DISTANCE if max_distance is None else max_distance
        best = [(scene.ids[o], squared[o]) for o in order[:k] if keep and squared[o] <= furthest]
        best += [(-1, NO_DISTANCE)] * (k - len(best))
        np.testing.assert_array_equal(ids[q], [i for i, _ in best])
        np.testing.assert_array_equal(distances[q], [s for _, s in best])


def test_search_across_chunks(coder: pm.Encoder, folder: Path) -> None:
    """A map larger than the search's chunks opens as it was sealed."""
    scene = pm.PrototypeMap(coder, dim=21)
    rng = np.random.default_rng(0)
    scene.add_codes(np.arange(3000), rng.integers(-127, 128, (3000, 21)).astype(np.int8))
    scene.set_positions([5], np.array([[1.0, 2.0, 3.0]]))
    scene.seal(folder / "large.pmk", bytes_per_landmark=7, tune=False)
    sealed = pm.open(folder / "large.pmk")
    assert isinstance(sealed, pm.SealedMap)
    assert "7 words" in repr(sealed)
    np.testing.assert_array_equal(sealed.positions([5]), [[1, 2, 3]])
    prototypes = sealed.prototypes(np.arange(3000)).astype(np.int64)
    descriptors = random_descriptors(50)
    codes = coder.encode(descriptors, 21).astype(np.int64)
    squared = ((codes[:, None] - prototypes[None]) ** 2).sum(-1)
    expected = np.argsort(squared, axis=1, kind="stable")[:, :3]
    np.testing.assert_array_equal(sealed.search(descriptors, k=3)[0], expected)


def test_bytes_per_landmark(coder: pm.Encoder, folder: Path) -> None:
    scene = pm.PrototypeMap(coder, dim=24)
    scene.add(np.arange(1600), random_descriptors(1600))
    scene.seal(folder / "a.pmk", bytes_per_landmark=12)
    sizes = dict(pm.file_sections(folder / "a.pmk"))
    assert set(sizes) == {"encoder", "shape", "width", "protos"}
    assert sizes["protos"] == 1600 * 24 // 2


def test_int8_where_it_fits(coder: pm.Encoder, folder: Path) -> None:
    scene = filled(coder, 12, 30, 100, 0)
    assert scene.seal(folder / "a.pmk").words == 0
    assert scene.seal(folder / "b.pmk", bytes_per_landmark=25).words == 0
    data = (folder / "a.pmk").read_bytes()
    assert data == (folder / "b.pmk").read_bytes()
    names = ["encoder", "shape", "rows", "protos", "idblocks", "idgaps"]
    assert [name for name, _ in sections(data)] == names
    assert scene.seal(folder / "b.pmk", bytes_per_landmark=24.99).words == 6
    assert pm.PrototypeMap(coder).seal(folder / "a.pmk", bytes_per_landmark=25).words == 0


@pytest.mark.parametrize(
    ("dim", "size", "expected"),
    [
        (24, 23.9, (24, 12)),
        (24, 12, (24, 12)),
        (24, 11.9, (22, 11)),
        (24, 9, (18, 9)),
        # 8 words of three numbers rather than of two.
        (24, 8.9, (24, 8)),
        (24, 7.5, (21, 7)),
        (24, 4, (12, 4)),
        (24, 1, (3, 1)),
        (9, 6, (8, 4)),
        (9, 3, (9, 3)),
    ],
)
def test_the_best_words_that_fit(
    dim: int, size: float, expected: tuple[int, int], coder: pm.Encoder, tmp_path: Path
) -> None:
    """Words of three numbers, unless 1.1 times as many of two fit."""
    scene, codes = pm.PrototypeMap(coder, dim=dim), random_codes(dim)
    scene.add_codes(np.arange(400) % 90, codes)
    scene.set_positions([7], [[1.0, 2, 3]])
    scene.metadata = {"frame": "ENU"}
    scene.build_index(5)
    sealed = scene.seal(tmp_path / "s.pmk", bytes_per_landmark=size)
    pm.verify_file(tmp_path / "s.pmk")
    assert (sealed.dim, sealed.words) == expected
    assert sealed.bytes_per_landmark == expected[1]
    assert (sealed.nlist, sealed.metadata["frame"], len(sealed)) == (5, "ENU", 90)
    np.testing.assert_array_equal(sealed.positions([7]), [[1, 2, 3]])
    means = rounded(scene.prototypes(scene.ids))[:, : expected[0]]
    numbers = quantized(means, CODEBOOKS[expected[0] // expected[1]])
    np.testing.assert_array_equal(sealed.prototypes(scene.ids), numbers)
    descriptors = random_descriptors(50)
    queries = coder.encode(descriptors, sealed.dim).astype(np.int64)
    squared = ((queries[:, None] - numbers[None]) ** 2).sum(-1)
    expected_ids = np.argsort(squared, axis=1, kind="stable")[:, :3]
    np.testing.assert_array_equal(sealed.search(descriptors, k=3)[0], expected_ids)


def random_codes(dim: int) -> NDArray[np.int8]:
    return np.random.default_rng(dim).integers(-127, 128, (400, dim)).astype(np.int8)


@pytest.mark.parametrize("size", [-4, 0, 1.99, float("nan"), -float("inf")])
def test_too_few_bytes_are_refused(size: float, encoder: pm.Encoder, tmp_path: Path) -> None:
    scene = filled(encoder, 12, 30, 100, 0)
    with pytest.raises(ValueError, match="bytes_per_landmark must be at least 2 for this map"):
        scene.seal(tmp_path / "s.pmk", bytes_per_landmark=size)
    assert not (tmp_path / "s.pmk").exists()
    scene.seal(tmp_path / "s.pmk", bytes_per_landmark=2)


def test_encoders_without_codebooks(plain: pm.Encoder, tmp_path: Path) -> None:
    scene = filled(plain, 12, 30, 100, 0)
    message = "bytes_per_landmark needs codebooks, which encoder 't' does not have for this map"
    for size in (0, 24.9):
        with pytest.raises(ValueError, match=message):
            scene.seal(tmp_path / "s.pmk", bytes_per_landmark=size)
    # Two numbers are no word of three.
    scene = filled(plain.with_codebooks([CODEBOOKS[3]]), 2, 30, 100, 0)
    with pytest.raises(ValueError, match=message):
        scene.seal(tmp_path / "s.pmk", bytes_per_landmark=5)
    assert scene.seal(tmp_path / "s.pmk", bytes_per_landmark=9).words == 0


def words(*values: int) -> bytes:
    return np.array(values, "<u4").tobytes()


@pytest.mark.parametrize(
    ("section", "content", "message"),
    [
        ("width", words(0), "no codebook for words of 0 numbers of 9"),
        ("width", words(2), "no codebook for words of 2 numbers of 9"),
        ("width", words(2**32 - 1), "no codebook for words of 4294967295 numbers"),
        ("width", b"", "section 'width' is shorter than it should be"),
        ("width", words(3, 0), "section 'width' is longer than it should be"),
        ("width", None, "section 'protos' has the wrong size"),
        ("protos", bytes(64), "section 'protos' has the wrong size"),
        ("protos", b"", "section 'protos' has the wrong size"),
        ("protos", None, "it lacks the section 'protos'"),
    ],
)
def test_hostile_sections_are_refused(
    section: str, content: bytes | None, message: str, coder: pm.Encoder, tmp_path: Path
) -> None:
    path = tmp_path / "s.pmk"
    filled(coder, 9, 20, 100, 0).seal(path, bytes_per_landmark=3)
    parts = sections(path.read_bytes())
    assert container(parts) == path.read_bytes()
    changed = [(name, content if name == section else old) for name, old in parts]
    path.write_bytes(container([(n, c) for n, c in changed if c is not None]))
    with pytest.raises(pm.FileError, match=message):
        pm.open(path)


def test_padding(coder: pm.Encoder, tmp_path: Path) -> None:
    """The search never reads the padding, 12 of 32 rows."""
    path = tmp_path / "s.pmk"
    sealed = filled(coder, 9, 20, 100, 0).seal(path, bytes_per_landmark=3)
    queries = np.random.default_rng(1).integers(-127, 128, (20, 9)).astype(np.int8)
    expected = sealed.search_codes(queries, k=20)
    parts = dict(sections(path.read_bytes()))
    protos = np.frombuffer(parts["protos"], np.uint8).reshape(2, 3, 16).copy()
    protos[1, :, 4:] = 0xFF
    path.unlink()
    path.write_bytes(container([*{**parts, "protos": protos.tobytes()}.items()]))
    for a, b in zip(pm.open(path).search_codes(queries, k=20), expected, strict=True):
        np.testing.assert_array_equal(a, b)


def test_later_formats_are_refused(coder: pm.Encoder, tmp_path: Path) -> None:
    path = tmp_path / "s.pmk"
    filled(coder, 9, 20, 100, 0).seal(path, bytes_per_landmark=3)
    path.write_bytes(container(sections(path.read_bytes()), version=2))
    with pytest.raises(pm.FileError, match="format version 2, this Protomark reads version 1"):
        pm.open(path)


def test_plain_code_gives_the_same_file_and_answers(coder: pm.Encoder, tmp_path: Path) -> None:
    """Each process chooses its instruction set at the start, so another one runs the plain code."""
    open_path, path = tmp_path / "o.pmk", tmp_path / "s.pmk"
    scene = filled(coder, 24, 900, 60, 3)
    scene.save(open_path)
    sealed = scene.seal(path, bytes_per_landmark=20)
    descriptors = random_descriptors(70)
    script = (
        "import sys, numpy as np, protomark as pm\n"
        "sealed = pm.open(sys.argv[1]).seal(sys.argv[2], bytes_per_landmark=20)\n"
        "ids, distances = sealed.search(np.load(sys.argv[3]), k=5)\n"
        "np.savez(sys.argv[4], ids=ids, distances=distances)\n"
    )
    np.save(tmp_path / "d.npy", descriptors)
    files = [open_path, tmp_path / "p.pmk", tmp_path / "d.npy", tmp_path / "r.npz"]
    subprocess.run(
        [sys.executable, "-c", script, *map(str, files)],
        env={**os.environ, "PROTOMARK_ISA": "portable"},
        check=True,
    )
    assert files[1].read_bytes() == path.read_bytes()
    answers: Any = np.load(files[3])
    ids, distances = sealed.search(descriptors, k=5)
    np.testing.assert_array_equal(answers["ids"], ids)
    np.testing.assert_array_equal(answers["distances"], distances)
