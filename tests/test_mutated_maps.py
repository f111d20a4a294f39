"""Thousands of broken model and map files: refused with their name, or read without harm."""

from __future__ import annotations

import zlib
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import protomark as pm
from conftest import descriptors_for, random_descriptors, vector_encoder
from map_container import container, sections
from mutation import FILES, SEED, bounded, mutated_container
from sealing import in_words


def scene(encoder: pm.Encoder, appearance_bits: int, nlist: int = 0) -> pm.PrototypeMap:
    scene = pm.PrototypeMap(encoder, appearance_bits=appearance_bits)
    scene.add(np.random.default_rng(0).integers(0, 30, 120) * 7, random_descriptors(120))
    scene.set_positions(scene.ids[::2], np.ones((len(scene.ids[::2]), 3)))
    scene.metadata = {"created": "2026-11-23T03:39:41Z", "frame": "ENU, metres", "x": "é"}
    if nlist:
        scene.build_index(nlist)
    return scene


def read_map(path: Path) -> None:
    read = pm.open(path)
    ids = read.ids
    assert len(ids) == len(read)
    queries = random_descriptors(3, read.encoder.bits)
    found, distances = read.search(queries)
    assert np.isin(found[found >= 0], ids).all()
    assert found.shape == distances.shape
    if read.nlist:
        for options in ({"nprobe": 2}, {"recall": 0.9}):
            found, _ = read.search(queries, **options)
            assert np.isin(found[found >= 0], ids).all()
    if isinstance(read, pm.PrototypeMap):
        read.counts(ids)
    read.prototypes(ids)
    assert all(name for name in read.metadata)
    assert read.summary()["landmarks_with_position"] <= len(read)
    positions = read.positions(ids)
    assert not np.isinf(positions).any()
    for landmark in ids[:5]:
        read.appearances(landmark)


def repaired(data: bytes) -> bytes:
    """The checksums of the owners are right, so that the reader gets to the broken owners."""
    try:
        parts = dict(sections(data))
        if container([*parts.items()]) != data or "ownercrc" not in parts:
            return data
    except (UnicodeDecodeError, MemoryError, OverflowError):
        return data
    owners = parts.get("owners", b"")
    pieces = [owners[at : at + 4096] for at in range(0, len(owners), 4096)]
    parts["ownercrc"] = b"".join(zlib.crc32(p).to_bytes(4, "little") for p in pieces)
    return container([*parts.items()])


def read_model(path: Path) -> None:
    encoder = pm.Encoder.load(path)
    with suppress(ValueError):  # an input scale that leaves nothing of a vector
        codes = encoder.encode(descriptors_for(encoder, 3))
        assert codes.min() >= -127


@pytest.mark.parametrize(
    "kind",
    [
        *("model", "model of vectors"),
        *("learning", "appearances", "learning with an index"),
        *("sealed", "sealed, 16-bit positions", "sealed with an index"),
        *("sealed with an index, owners repaired", "sealed, words, several prototypes"),
    ],
)
def test_broken_files_are_refused_or_read(kind: str, encoder: pm.Encoder, tmp_path: Path) -> None:
    print(f"PROTOMARK_SEED={SEED}")
    rng = np.random.default_rng(SEED)
    path = tmp_path / "file"
    {
        "model": encoder.save,
        "model of vectors": vector_encoder("float32").save,
        "learning": scene(encoder, 0).save,
        "appearances": scene(encoder, 3).save,
        "learning with an index": scene(encoder, 3, nlist=5).save,
        "sealed": scene(encoder, 0).seal,
        "sealed, 16-bit positions": partial(scene(encoder, 0).seal, position_bits=16),
        "sealed with an index": scene(encoder, 3, nlist=5).seal,
        "sealed with an index, owners repaired": scene(encoder, 3, nlist=5).seal,
        "sealed, words, several prototypes": partial(
            scene(encoder, 3).seal, bytes_per_landmark=in_words(scene(encoder, 3))
        ),
    }[kind](path)
    whole = path.read_bytes()
    read = read_model if kind.startswith("model") else read_map
    read(path)
    refused = 0
    with bounded():
        for _ in range(FILES):
            path.unlink()  # never in place: another map may have it mapped
            broken = mutated_container(whole, rng)
            path.write_bytes(repaired(broken) if kind.endswith("repaired") else broken)
            unnamed = False
            try:
                read(path)
            except pm.FileError as error:
                unnamed = not str(error).startswith(f"{path}: ")
                refused += 1
            assert not unnamed
            for check in (pm.verify_file, pm.file_sections):
                with suppress(pm.FileError):
                    check(path)
    print(f"{refused} of {FILES} refused")
    assert FILES / 4 < refused < FILES
