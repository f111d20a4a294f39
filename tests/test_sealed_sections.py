"""Ids, positions and summaries of sealed maps."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import protomark as pm
from conftest import balanced_encoder, protomark, random_descriptors
from map_container import container, sections
from sealing import in_words

MOST = 2**63 - 1


def scene(encoder: pm.Encoder, ids: Any) -> pm.PrototypeMap:
    scene = pm.PrototypeMap(encoder)
    scene.add(ids, random_descriptors(len(ids)))
    return scene


@settings(max_examples=60)
@given(
    st.one_of(
        st.lists(st.integers(0, 400), unique=True, max_size=300),
        st.lists(st.integers(0, MOST), unique=True, max_size=300),
        st.builds(range, st.integers(0, 5), st.integers(0, 500), st.integers(1, 2**50)),
    )
)
def test_any_ids(
    encoder: pm.Encoder, tmp_path_factory: pytest.TempPathFactory, ids: list[int]
) -> None:
    path = tmp_path_factory.mktemp("ids") / "sealed.pmk"
    built = scene(encoder, np.array(ids, np.int64))
    sealed = built.seal(path)
    np.testing.assert_array_equal(sealed.ids, np.sort(np.array(ids, np.int64)))
    queries = random_descriptors(20, seed=1)
    for a, b in zip(built.search(queries, k=3), sealed.search(queries, k=3), strict=True):
        np.testing.assert_array_equal(a, b)
    known = set(ids)
    for near in {i + d for i in ids[:20] for d in (-1, 1)} - known - {-1, MOST + 1}:
        with pytest.raises(KeyError):
            sealed.positions([near])
    pm.verify_file(path)


def test_search_with_an_index_gives_ids(encoder: pm.Encoder, tmp_path: Path) -> None:
    ids = np.random.default_rng(2).integers(0, MOST, 500)
    built = scene(encoder, ids)
    built.build_index(8)
    sealed = built.seal(tmp_path / "sealed.pmk")
    queries = random_descriptors(50, seed=1)
    for options in ({}, {"nprobe": 2}):
        for a, b in zip(
            built.search(queries, **options), sealed.search(queries, **options), strict=True
        ):
            np.testing.assert_array_equal(a, b)


def test_broken_ids_are_met_when_they_are_read(encoder: pm.Encoder, tmp_path: Path) -> None:
    path = tmp_path / "sealed.pmk"
    scene(encoder, np.arange(300) * 7).seal(path)
    for content in (b"\xff", b"\0"):
        parts = [
            (name, content * len(data) if name == "idgaps" else data)
            for name, data in sections(path.read_bytes())
        ]
        (tmp_path / "broken.pmk").write_bytes(container(parts))
        broken = pm.open(tmp_path / "broken.pmk")
        assert len(broken) == 300
        if content == b"\xff":
            with pytest.raises(pm.FileError, match=r"broken\.pmk: its landmark ids do not ascend"):
                broken.search(random_descriptors(300), k=300)
            with pytest.raises(pm.FileError, match=r"broken\.pmk: its landmark ids do not ascend"):
                _ = broken.ids
        else:
            assert len(np.unique(broken.ids)) == 300  # other ids, and still no two equal


@pytest.mark.parametrize("scale", [[100, 100, 3], [1e-3, 1, 1e6], [0, 5, 0]])
def test_positions_of_16_bits(encoder: pm.Encoder, scale: list[float], tmp_path: Path) -> None:
    built = scene(encoder, np.arange(3000) * 3)
    placed = built.ids[::2]
    positions = np.random.default_rng(1).uniform(-1, 1, (len(placed), 3)) * scale + [5e5, -4e6, 7]
    built.set_positions(placed, positions)
    sealed = built.seal(tmp_path / "16.pmk", position_bits=16)
    exact = built.seal(tmp_path / "32.pmk")
    assert (sealed.position_bits, exact.position_bits) == (16, 32)
    assert exact.position_error is None
    error = sealed.position_error
    extent = positions.max(0) - positions.min(0)
    np.testing.assert_allclose(error, extent / 65534 / 2, rtol=1e-12)
    off = np.abs(sealed.positions(placed) - positions)
    # Half a step, and the rounding of numbers of 4e6 in float64.
    assert (off <= error + 4e-9).all()
    assert (off.max(0) >= error * 0.9).all()
    assert np.isnan(sealed.positions(built.ids[1::2])).all()
    low, high = sealed.summary()["extent"]
    np.testing.assert_allclose([low, high], [positions.min(0), positions.max(0)], rtol=1e-14)
    sizes = [dict(pm.file_sections(tmp_path / name))["position"] for name in ("16.pmk", "32.pmk")]
    assert sizes == [3000 * 6, 3000 * 12]
    with pytest.raises(ValueError, match="position_bits must be 32, 16 or 0, not 8"):
        built.seal(tmp_path / "8.pmk", position_bits=8)
    assert not (tmp_path / "8.pmk").exists()


def test_summary(encoder: pm.Encoder, tmp_path: Path) -> None:
    for appearance_bits in (0, 3):
        built = pm.PrototypeMap(encoder, appearance_bits=appearance_bits)
        nothing = built.summary()
        assert (nothing["observations"], nothing["extent"]) == (0, None)
        assert not nothing["count_histogram"].any()
        ids = np.random.default_rng(3).geometric(0.01, 5000) * 2
        built.add(ids, random_descriptors(5000))
        counts = np.bincount(ids)
        built.set_positions(built.ids[:2], [[1, 5, 3], [4, 2, 3]])
        for m in (
            built,
            built.seal(tmp_path / "s.pmk"),
            built.seal(tmp_path / "t.pmk", bytes_per_landmark=in_words(built)),
        ):
            summary = m.summary()
            assert ("observations" in summary) == (m is built)
            if m is built:
                assert summary["observations"] == 5000
                np.testing.assert_array_equal(
                    summary["count_histogram"], np.bincount(counts[counts > 0], minlength=256)
                )
            assert summary["landmarks_with_position"] == 2
            np.testing.assert_array_equal(summary["extent"], [[1, 2, 3], [4, 5, 3]])


def test_info_of_a_sealed_map(encoder: pm.Encoder, tmp_path: Path) -> None:
    built = scene(encoder, np.arange(500) + 1)
    built.metadata = {"frame": "ENU, [bold]metres", "bell": "\a\x1b[31m"}
    built.set_positions([1, 2], [[0, 0, 0], [65534, 10, 0]])
    built.seal(tmp_path / "s.pmk", position_bits=16)
    done = protomark("info", tmp_path / "s.pmk", "--json", tmp_path / "facts.json")
    assert done.returncode == 0, done.stderr
    import json

    facts = json.loads((tmp_path / "facts.json").read_text())
    assert facts["metadata"] == dict(built.metadata)
    assert facts["position_bits"] == 16
    assert facts["position_error"] == [0.5, 10 / 65534 / 2, 0]
    assert facts["extent"] == [[0, 0, 0], [65534, 10, 0]]
    assert facts["observations"] is None
    assert facts["landmarks_with_position"] == 2
    by_section = facts["bytes_by_section"]
    assert by_section["idblocks"] == 4 * 16
    assert by_section["idgaps"] == 0
    assert facts["bytes_per_landmark_by_section"] == {
        name: size / 500 for name, size in by_section.items()
    }
    assert facts["bytes_per_landmark_for_matching"] == 12 + 4 * 16 / 500
    assert facts["encoder"]["identity"] == encoder.identity
    assert "ENU, [bold]metres" in done.stdout
    assert "\a" not in done.stdout
    assert "\x1b" not in done.stdout
    assert r"\x07\x1b[31m" in done.stdout
    assert "(0, 0, 0) to (65,534, 10, 0)" in done.stdout


@pytest.mark.parametrize("how", ["cp", "append", "truncate"])
def test_a_map_that_was_written_into_while_open_answers_no_more(how: str, tmp_path: Path) -> None:
    learning = pm.PrototypeMap(balanced_encoder())
    learning.add(np.arange(0, 3000, 3), random_descriptors(1000))
    path, other = tmp_path / "scene.sealed.pmk", tmp_path / "other.sealed.pmk"
    sealed = learning.seal(path)
    learning.add(np.arange(5000), random_descriptors(5000, seed=2))
    learning.seal(other)
    codes = np.zeros((1, learning.dim), np.int8)
    sealed.search_codes(codes)
    if how == "cp":
        path.write_bytes(other.read_bytes())
    elif how == "append":
        with path.open("ab") as file:
            file.write(b"more")
    else:
        os.truncate(path, 100)
    for call in (
        lambda: sealed.search_codes(codes),
        lambda: sealed.positions([0]),
        lambda: sealed.prototypes([0]),
        lambda: sealed.appearances(0),
        lambda: sealed.ids,
        sealed.summary,
    ):
        with pytest.raises(pm.FileError, match=r"written to while it was open.*by renaming"):
            call()


def test_a_map_that_was_replaced_by_renaming_goes_on(tmp_path: Path) -> None:
    learning = pm.PrototypeMap(balanced_encoder())
    learning.add(np.arange(100), random_descriptors(100))
    sealed = learning.seal(tmp_path / "scene.sealed.pmk")
    codes = learning.encoder.encode(random_descriptors(5, seed=3))
    before = sealed.search_codes(codes)
    learning.add(np.arange(200), random_descriptors(200, seed=2))
    again = learning.seal(tmp_path / "scene.sealed.pmk")
    np.testing.assert_array_equal(sealed.search_codes(codes)[1], before[1])
    assert (len(sealed), len(again)) == (100, 200)
    (tmp_path / "scene.sealed.pmk").unlink()
    np.testing.assert_array_equal(sealed.search_codes(codes)[1], before[1])
