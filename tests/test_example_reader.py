"""The example reader, written from docs/format.md alone, compared with the core."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

import protomark as pm
from conftest import descriptors_for, random_descriptors, rounded, vector_encoder
from map_container import READER
from sealing import in_words


def scene(encoder: pm.Encoder, dim: int, appearance_bits: int, step: int) -> pm.PrototypeMap:
    scene = pm.PrototypeMap(encoder, dim=dim, appearance_bits=appearance_bits)
    ids = np.random.default_rng(0).integers(0, 100, 600) * step
    scene.add(ids, random_descriptors(600))
    some = scene.ids[::2]
    scene.set_positions(some, np.random.default_rng(1).normal(5e5, 10, (len(some), 3)))
    scene.metadata = {"frame": "ENU, mètres", "created": "2026-11-23T03:39:41Z", "empty": ""}
    return scene


@pytest.mark.parametrize("input", ["bits", "uint8", "float32"])
def test_the_same_codes(input: str, encoder: pm.Encoder, tmp_path: Path) -> None:
    if input != "bits":
        encoder = vector_encoder(input)
    encoder.save(tmp_path / "x.pme")
    read = READER["Encoder"]((tmp_path / "x.pme").read_bytes())
    descriptors = descriptors_for(encoder, 200)
    assert read.dims == encoder.dims
    for dim in encoder.dims:
        np.testing.assert_array_equal(
            read.encode(descriptors, dim), encoder.encode(descriptors, dim)
        )


@pytest.mark.parametrize("appearance_bits", [0, 4])
@pytest.mark.parametrize("dim", [5, 12])
@pytest.mark.parametrize(
    "kind", ["learning", "sealed", "words", "merged", "16-bit positions", "index", "index, words"]
)
def test_the_same_answers(
    kind: str, dim: int, appearance_bits: int, encoder: pm.Encoder, tmp_path: Path
) -> None:
    built = scene(encoder, dim, appearance_bits, step=7 if dim == 5 else 1)
    if kind.startswith("index"):
        built.build_index(7)
    path = tmp_path / "map.pmk"
    {
        "learning": built.save,
        "sealed": built.seal,
        "words": partial(built.seal, bytes_per_landmark=in_words(built)),
        "merged": partial(built.seal, bytes_per_landmark=in_words(built, 1.5)),
        "16-bit positions": partial(built.seal, position_bits=16),
        "index": built.seal,
        "index, words": partial(built.seal, bytes_per_landmark=in_words(built)),
    }[kind](path)
    ours, theirs = pm.open(path), READER["Map"](path.read_bytes())
    ids = ours.ids
    np.testing.assert_array_equal(theirs.ids, ids)
    assert theirs.metadata == ours.metadata
    np.testing.assert_array_equal(theirs.positions, ours.positions(ids))
    assert len(theirs.prototypes) == ours.prototype_count
    for landmark in ids[:20]:
        np.testing.assert_array_equal(
            theirs.prototypes[theirs.landmarks == landmark], rounded(ours.appearances(landmark))
        )
    if kind == "learning":
        counts = [theirs.counts[theirs.landmarks == i].sum() for i in ids]
        np.testing.assert_array_equal(counts, np.minimum(ours.counts(ids), 255))
    queries = random_descriptors(300, seed=9)
    for a, b in zip(theirs.search(queries), ours.search(queries, k=1), strict=True):
        np.testing.assert_array_equal(a, b[:, 0])


def test_broken_files_are_refused(encoder: pm.Encoder, tmp_path: Path) -> None:
    scene(encoder, 12, 0, 1).save(tmp_path / "map.pmk")
    data = (tmp_path / "map.pmk").read_bytes()
    last = len(data.rstrip(b"\0")) - 1
    for broken in (b"", b"PK\x03\x04" * 50, data[:-64], data[:40] + b"x" + data[41:]):
        with pytest.raises(ValueError, match=r"not a Protomark file|cut off|checksum"):
            READER["Map"](broken)
    with pytest.raises(ValueError, match="checksum"):
        READER["Map"](data[:last] + bytes([data[last] ^ 1]) + data[last + 1 :])
