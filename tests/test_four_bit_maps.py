"""Sealed maps of 4 bits per number, compared with docs/format.md in NumPy."""

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
from conftest import NO_DISTANCE, random_descriptors, random_layers, rounded
from map_container import container, sections
from sealing import best_scale, four_bits, levels, quantized


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sealed")


@pytest.fixture(scope="module")
def coder() -> pm.Encoder:
    """Code lengths around the 8 dimensions that are packed together, and larger ones."""
    dims = [1, 3, 4, 5, 7, 8, 9, 12, 16, 21]
    return pm.Encoder(random_layers([64, 40, 21]), dims, name="t", descriptor="test", scale=0.02)


def filled(coder: pm.Encoder, dim: int, n: int, limit: int, seed: int) -> pm.PrototypeMap:
    """A map whose prototypes reach up to `limit`.

    Up to 4 dimensions take the same bytes with 8 bits, so that only merging gives maps of 4 bits:
    such landmarks have two appearances.
    """
    rng = np.random.default_rng(seed)
    scene = pm.PrototypeMap(coder, dim=dim, appearance_bits=int(dim <= 4))
    ids = rng.choice(1000, n, replace=False)
    for sign in (1, -1):
        codes = rng.integers(-limit, limit + 1, (n, dim)).astype(np.int8)
        codes[:, 0] = np.where(dim <= 4, sign * np.maximum(abs(codes[:, 0]), 1), codes[:, 0])
        scene.add_codes(ids, codes)
    return scene


def read_levels(path: Path, n: int, k: int) -> NDArray[np.int64]:
    """Reads the prototypes of a file by docs/format.md."""
    found = dict(sections(path.read_bytes()))
    scale = int.from_bytes(found["sq4scale"], "little")
    k8, n16 = -(-k // 8) * 8, -(-n // 16) * 16
    b = np.frombuffer(found["protos"], np.uint8).reshape(n16 // 16, k8 // 8, 16, 4)
    u = np.concatenate([b & 15, b >> 4], axis=3).transpose(0, 2, 1, 3).reshape(n16, k8)
    assert not u[n:].any()
    assert not u[:, k:].any()
    return levels(scale)[u[:n, :k]]


@settings(max_examples=60, deadline=None)
@given(
    n=st.integers(1, 40),
    k=st.integers(1, 4),
    dim=st.sampled_from([1, 3, 4, 5, 7, 8, 9, 12, 16, 21]),
    limit=st.integers(0, 127),
    max_distance=st.none() | st.integers(0, 90_000),
    ratio=st.none() | st.floats(0.25, 1),
    threads=st.integers(1, 3),
    seed=st.integers(0, 2**32 - 1),
)
def test_levels_and_search_equal_the_definition(
    n: int,
    k: int,
    dim: int,
    limit: int,
    max_distance: int | None,
    ratio: float | None,
    threads: int,
    seed: int,
    coder: pm.Encoder,
    folder: Path,
) -> None:
    scene = filled(coder, dim, n, limit, seed)
    sealed = scene.seal(folder / "s.pmk", bytes_per_landmark=four_bits(scene, 1))
    pm.verify_file(folder / "s.pmk")
    means = rounded(scene.prototypes(scene.ids))
    expected = quantized(means, best_scale(means))
    np.testing.assert_array_equal(read_levels(folder / "s.pmk", n, dim), expected)
    np.testing.assert_array_equal(sealed.prototypes(scene.ids), expected)
    np.testing.assert_array_equal(sealed.ids, scene.ids)
    np.testing.assert_array_equal(sealed.counts(scene.ids), scene.counts(scene.ids))
    assert (len(sealed), sealed.dim, sealed.code_bits) == (n, dim, 4)

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
    scene.seal(folder / "large.pmk", bytes_per_landmark=four_bits(scene))
    sealed = pm.open(folder / "large.pmk")
    assert isinstance(sealed, pm.SealedMap)
    assert "4 bits per number" in repr(sealed)
    np.testing.assert_array_equal(sealed.positions([5]), [[1, 2, 3]])
    prototypes = sealed.prototypes(np.arange(3000)).astype(np.int64)
    descriptors = random_descriptors(50)
    codes = coder.encode(descriptors).astype(np.int64)
    squared = ((codes[:, None] - prototypes[None]) ** 2).sum(-1)
    expected = np.argsort(squared, axis=1, kind="stable")[:, :3]
    np.testing.assert_array_equal(sealed.search(descriptors, k=3)[0], expected)


def test_bytes_per_landmark(coder: pm.Encoder, folder: Path) -> None:
    scene = pm.PrototypeMap(coder, dim=16)
    scene.add(np.arange(1600), random_descriptors(1600))
    scene.seal(folder / "a.pmk", bytes_per_landmark=9)
    sizes = dict(pm.file_sections(folder / "a.pmk"))
    assert set(sizes) == {"encoder", "shape", "counts", "sq4scale", "protos"}
    assert sizes["counts"] + sizes["protos"] == 1600 * (16 // 2 + 1)


def test_8_bits_where_they_fit(coder: pm.Encoder, folder: Path) -> None:
    scene = filled(coder, 12, 30, 100, 0)
    assert scene.seal(folder / "a.pmk").code_bits == 8
    assert scene.seal(folder / "b.pmk", bytes_per_landmark=13).code_bits == 8
    data = (folder / "a.pmk").read_bytes()
    assert data == (folder / "b.pmk").read_bytes()
    ids = ["idblocks", "idgaps"]
    assert [name for name, _ in sections(data)] == ["encoder", "shape", "counts", "protos", *ids]
    assert scene.seal(folder / "b.pmk", bytes_per_landmark=12.99).code_bits == 4
    assert pm.PrototypeMap(coder).seal(folder / "a.pmk", bytes_per_landmark=13).code_bits == 8


@pytest.mark.parametrize("size", [-4, 0, 8.99, float("nan"), -float("inf")])
def test_too_few_bytes_are_refused(size: float, coder: pm.Encoder, tmp_path: Path) -> None:
    scene = filled(coder, 12, 30, 100, 0)
    with pytest.raises(ValueError, match="bytes_per_landmark must be at least 9 for this map"):
        scene.seal(tmp_path / "s.pmk", bytes_per_landmark=size)
    assert not (tmp_path / "s.pmk").exists()
    scene.seal(tmp_path / "s.pmk", bytes_per_landmark=9)


def words(*values: int) -> bytes:
    return np.array(values, "<u4").tobytes()


@pytest.mark.parametrize(
    ("section", "content", "message"),
    [
        ("sq4scale", words(0), "scale of its prototypes is 0, not 1 to 8"),
        ("sq4scale", words(9), "scale of its prototypes is 9, not 1 to 8"),
        ("sq4scale", words(2**32 - 1), "scale of its prototypes is 4294967295"),
        ("sq4scale", b"", "section 'sq4scale' is shorter than it should be"),
        ("sq4scale", words(1, 0), "section 'sq4scale' is longer than it should be"),
        ("sq4scale", None, "section 'protos' has the wrong size"),
        ("protos", bytes(64), "section 'protos' has the wrong size"),
        ("protos", b"", "section 'protos' has the wrong size"),
        ("protos", None, "it lacks the section 'protos'"),
        ("counts", bytes(1), "section 'counts' has the wrong size"),
    ],
)
def test_hostile_sections_are_refused(
    section: str, content: bytes | None, message: str, coder: pm.Encoder, tmp_path: Path
) -> None:
    path = tmp_path / "s.pmk"
    filled(coder, 9, 20, 100, 0).seal(path, bytes_per_landmark=9)
    parts = sections(path.read_bytes())
    assert container(parts) == path.read_bytes()
    changed = [(name, content if name == section else old) for name, old in parts]
    path.write_bytes(container([(n, c) for n, c in changed if c is not None]))
    with pytest.raises(pm.FileError, match=message):
        pm.open(path)


def test_padding(coder: pm.Encoder, tmp_path: Path) -> None:
    """The search never reads the padding, 7 of 16 dimensions and 12 of 32 rows."""
    path = tmp_path / "s.pmk"
    sealed = filled(coder, 9, 20, 100, 0).seal(path, bytes_per_landmark=9)
    queries = np.random.default_rng(1).integers(-127, 128, (20, 9)).astype(np.int8)
    expected = sealed.search_codes(queries, k=20)
    parts = dict(sections(path.read_bytes()))
    protos = np.frombuffer(parts["protos"], np.uint8).reshape(2, 2, 16, 4).copy()
    protos[:, 1, :, 0] |= 0xF0
    protos[:, 1, :, 1:] = 0xFF
    protos[1, :, 4:] = 0xFF
    path.unlink()
    path.write_bytes(container([*{**parts, "protos": protos.tobytes()}.items()]))
    for a, b in zip(pm.open(path).search_codes(queries, k=20), expected, strict=True):
        np.testing.assert_array_equal(a, b)


def test_later_formats_are_refused(coder: pm.Encoder, tmp_path: Path) -> None:
    path = tmp_path / "s.pmk"
    filled(coder, 9, 20, 100, 0).seal(path, bytes_per_landmark=9)
    path.write_bytes(container(sections(path.read_bytes()), version=2))
    with pytest.raises(pm.FileError, match="format version 2, this Protomark reads version 1"):
        pm.open(path)


def test_plain_code_gives_the_same_file_and_answers(coder: pm.Encoder, tmp_path: Path) -> None:
    """Each process chooses its instruction set at the start, so another one runs the plain code."""
    open_path, path = tmp_path / "o.pmk", tmp_path / "s.pmk"
    scene = filled(coder, 21, 900, 60, 3)
    scene.save(open_path)
    sealed = scene.seal(path, bytes_per_landmark=13)
    descriptors = random_descriptors(70)
    script = (
        "import sys, numpy as np, protomark as pm\n"
        "sealed = pm.open(sys.argv[1]).seal(sys.argv[2], bytes_per_landmark=13)\n"
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
