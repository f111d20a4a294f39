from __future__ import annotations

import os
import zlib
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import protomark as pm
from conftest import random_descriptors, rounded
from map_container import LEARNING_MAP, container, sections
from sealing import in_words


@pytest.fixture
def scene(encoder: pm.Encoder) -> pm.PrototypeMap:
    scene = pm.PrototypeMap(encoder)
    ids = np.random.default_rng(0).integers(0, 60, 300) * 7
    scene.add(ids, random_descriptors(300))
    some = scene.ids[::2]
    scene.set_positions(some, np.random.default_rng(1).normal(5e5, 10, (len(some), 3)))
    return scene


def test_learning_map_round_trip(scene: pm.PrototypeMap, tmp_path: Path) -> None:
    path = tmp_path / "scene.pmk"
    scene.save(path)
    read = pm.open(path)
    assert isinstance(read, pm.PrototypeMap)
    ids = scene.ids
    np.testing.assert_array_equal(read.ids, ids)
    np.testing.assert_array_equal(read.counts(ids), scene.counts(ids))
    np.testing.assert_array_equal(read.prototypes(ids), scene.prototypes(ids))
    np.testing.assert_array_equal(read.positions(ids), scene.positions(ids))
    for a, b in zip(
        read.search(random_descriptors(9)), scene.search(random_descriptors(9)), strict=True
    ):
        np.testing.assert_array_equal(a, b)
    read.add([1000], random_descriptors(1))
    read.subtract([1000], random_descriptors(1))
    read.save(tmp_path / "again.pmk")
    assert (tmp_path / "again.pmk").read_bytes() == path.read_bytes()


def test_sealed_map_answers_like_the_learning_one(scene: pm.PrototypeMap, tmp_path: Path) -> None:
    sealed = scene.seal(tmp_path / "scene.sealed.pmk")
    reopened = pm.open(tmp_path / "scene.sealed.pmk")
    assert isinstance(reopened, pm.SealedMap)
    queries, ids = random_descriptors(40, seed=3), scene.ids
    for m in (sealed, reopened):
        assert len(m) == len(scene)
        assert m.dim == scene.dim
        np.testing.assert_array_equal(m.ids, ids)
        np.testing.assert_array_equal(m.prototypes(ids), rounded(scene.prototypes(ids)))
        np.testing.assert_allclose(m.positions(ids), scene.positions(ids), atol=1e-5)
        for kwargs in ({"k": 3}, {"k": 1, "ratio": 0.9}, {"k": 2, "max_distance": 40_000}):
            for a, b in zip(
                m.search(queries, **kwargs), scene.search(queries, **kwargs), strict=True
            ):
                np.testing.assert_array_equal(a, b)
        with pytest.raises(KeyError, match="landmark 1 is not in the map"):
            m.positions([1])


def test_sealed_map_takes_dim_bytes_a_landmark(encoder: pm.Encoder, tmp_path: Path) -> None:
    scene = pm.PrototypeMap(encoder)
    scene.add(np.arange(1600), random_descriptors(1600))
    scene.seal(tmp_path / "a.pmk")
    sections = dict(pm.file_sections(tmp_path / "a.pmk"))
    assert set(sections) == {"encoder", "shape", "protos"}
    assert sections["protos"] == 1600 * 12


def test_empty_and_single_maps(encoder: pm.Encoder, tmp_path: Path) -> None:
    for n in (0, 1):
        scene = pm.PrototypeMap(encoder)
        scene.add(np.arange(n), random_descriptors(n))
        scene.save(tmp_path / "o.pmk")
        sealed = scene.seal(tmp_path / "s.pmk")
        read = pm.open(tmp_path / "o.pmk")
        assert len(read) == len(sealed) == n
        np.testing.assert_array_equal(sealed.search(random_descriptors(2))[0][:, 0], [n - 1] * 2)


def test_checksums_are_those_of_zlib(scene: pm.PrototypeMap, tmp_path: Path) -> None:
    """Reads a file by docs/format.md, without Protomark."""
    scene.save(tmp_path / "scene.pmk")
    data = (tmp_path / "scene.pmk").read_bytes()
    sections = int.from_bytes(data[24:28], "little")
    crc = int.from_bytes(data[28:32], "little")
    assert data[:8] == b"PROTOMRK"
    assert int.from_bytes(data[16:24], "little") == len(data)
    header = data[:28] + bytes(4) + data[32 : 64 + 32 * sections]
    assert zlib.crc32(header) == crc
    for i in range(sections):
        entry = data[64 + 32 * i : 96 + 32 * i]
        begin, size = (int.from_bytes(entry[a : a + 8], "little") for a in (8, 16))
        assert begin % 64 == 0
        assert zlib.crc32(data[begin : begin + size]) == int.from_bytes(entry[24:28], "little")


def test_every_truncation_is_refused(encoder: pm.Encoder, tmp_path: Path) -> None:
    scene = pm.PrototypeMap(encoder)
    scene.add(np.arange(3), random_descriptors(3))
    scene.save(tmp_path / "whole.pmk")
    data = (tmp_path / "whole.pmk").read_bytes()
    broken = tmp_path / "broken.pmk"
    for size in range(0, len(data), 37):
        broken.write_bytes(data[:size])
        with pytest.raises(pm.FileError, match=r"broken\.pmk: "):
            pm.open(broken)


def section_bytes(data: bytes) -> set[int]:
    """Offsets of all bytes that a checksum covers: header, table and sections, not the gaps."""
    sections = int.from_bytes(data[24:28], "little")
    covered = set(range(64 + 32 * sections))
    for i in range(sections):
        entry = data[64 + 32 * i : 96 + 32 * i]
        begin, size = (int.from_bytes(entry[a : a + 8], "little") for a in (8, 16))
        covered |= set(range(begin, begin + size))
    return covered


@pytest.mark.parametrize("kind", ["model", "learning", "sealed", "sealed, words"])
def test_every_flipped_byte_is_noticed(kind: str, scene: pm.PrototypeMap, tmp_path: Path) -> None:
    path = tmp_path / "file"
    {
        "model": scene.encoder.save,
        "learning": scene.save,
        "sealed": scene.seal,
        "sealed, words": partial(scene.seal, bytes_per_landmark=in_words(scene)),
    }[kind](path)
    data = path.read_bytes()
    covered = section_bytes(data)
    rng = np.random.default_rng(5)
    places = [*range(256), *rng.choice(len(data), 400, replace=False)]
    for at in places:
        flipped = bytearray(data)
        flipped[at] ^= int(rng.integers(1, 256))
        path.write_bytes(flipped)
        if at in covered:
            with pytest.raises(pm.FileError, match="file: "):
                pm.verify_file(path)
        # What is not verified must still never crash.
        try:
            if kind == "model":
                pm.Encoder.load(path)
            else:
                pm.open(path).search(random_descriptors(1))
        except pm.FileError:
            assert at in covered


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a Protomark file"),
        (b"PK\x03\x04" * 100, "not a Protomark file"),
        (b"PROTOMRK" + bytes(56), "format version 0"),
    ],
)
def test_foreign_files_are_named(content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "stranger.pmk"
    path.write_bytes(content)
    for load in (pm.open, pm.Encoder.load):
        with pytest.raises(pm.FileError, match=f"stranger.pmk: {message}"):
            load(path)


def test_a_model_is_not_a_map(encoder: pm.Encoder, tmp_path: Path) -> None:
    encoder.save(tmp_path / "x.pme")
    with pytest.raises(pm.FileError, match="it holds an encoder, not a map"):
        pm.open(tmp_path / "x.pme")
    pm.PrototypeMap(encoder).save(tmp_path / "x.pmk")
    with pytest.raises(pm.FileError, match="it holds a learning map, not an encoder"):
        pm.Encoder.load(tmp_path / "x.pmk")
    with pytest.raises(pm.FileError, match=r"missing.pmk: cannot be read: No such file"):
        pm.open(tmp_path / "missing.pmk")
    with pytest.raises(FileNotFoundError, match="holds no scene"):
        pm.open(tmp_path)


def test_a_failed_save_leaves_the_old_file(scene: pm.PrototypeMap, tmp_path: Path) -> None:
    with pytest.raises(pm.FileError, match="cannot be written: No such file or directory"):
        scene.save(tmp_path / "nowhere" / "scene.pmk")
    path = tmp_path / "scene.pmk"
    scene.save(path)
    before = path.read_bytes()
    resource = pytest.importorskip("resource")
    import signal

    # A file size limit makes the write fail in the middle, as a full disk does.
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, old[1]))
        with pytest.raises(pm.FileError, match="cannot be written: File too large"):
            scene.save(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
        signal.signal(signal.SIGXFSZ, handler)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["scene.pmk"]


def test_paths_that_are_not_utf8(scene: pm.PrototypeMap, tmp_path: Path) -> None:
    path = os.path.join(tmp_path, os.fsdecode(b"\xff.pmk"))
    nowhere = os.path.join(path, "a.pmk")
    for failing in (
        partial(pm.open, path),
        partial(pm.open, path, journal=True),
        partial(pm.Encoder.load, path),
        partial(pm.file_sections, path),
        partial(scene.save, nowhere),
        partial(scene.seal, nowhere),
    ):
        with pytest.raises(OSError, match=r"No such file|neither a model") as error:
            failing()
        assert path in str(error.value)
    try:
        scene.save(path)
    except pm.FileError:
        pytest.skip("the file system takes no such name")
    assert len(pm.open(path)) == len(scene)
    with pytest.raises(ValueError, match="not of other") as mismatch:
        pm.open(path, descriptor="other")
    assert path in str(mismatch.value)


@pytest.mark.parametrize("name", [b"\xff\xfe", b"\x1b[2J", b"a\nb"])
def test_names_of_sections_are_printable_ascii(
    scene: pm.PrototypeMap, tmp_path: Path, name: bytes
) -> None:
    path = tmp_path / "scene.pmk"
    scene.save(path)
    parts = sections(path.read_bytes())
    data = container([*parts, ("12345678", b"")], version=1, kind=LEARNING_MAP)
    data = data.replace(b"12345678", name.ljust(8, b"\0"))
    end = 64 + 32 * (len(parts) + 1)
    crc = zlib.crc32(data[:28] + bytes(4) + data[32:end])
    path.write_bytes(data[:28] + crc.to_bytes(4, "little") + data[32:])
    for read in (pm.open, pm.file_sections, pm.verify_file):
        with pytest.raises(pm.FileError, match="a name is not printable ASCII") as error:
            read(path)
        assert str(error.value).isprintable()
