"""Metadata of maps, and the encoder that a map belongs to."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import protomark as pm
from conftest import protomark, random_descriptors, random_layers
from map_container import SEALED_MAP, container, sections

CREATED = "2026-11-23T03:39:41Z"


@pytest.fixture
def scene(encoder: pm.Encoder) -> pm.PrototypeMap:
    scene = pm.PrototypeMap(encoder)
    scene.add(np.arange(20) * 3, random_descriptors(20))
    return scene


def other_encoder(descriptor: str = "test") -> pm.Encoder:
    return pm.Encoder(
        random_layers([64, 12], seed=8), [12], name="other", descriptor=descriptor, scale=0.02
    )


def test_a_new_map_says_nothing(scene: pm.PrototypeMap, tmp_path: Path) -> None:
    assert dict(scene.metadata) == {}
    scene.save(tmp_path / "scene.pmk")
    assert "metadata" not in dict(pm.file_sections(tmp_path / "scene.pmk"))


def test_it_is_assigned(scene: pm.PrototypeMap) -> None:
    scene.metadata = {"frame": "ENU, metres"}
    before = scene.metadata
    scene.metadata = scene.metadata | {"created": CREATED, "Ort": "Zürich 🏔"}
    assert scene.metadata == {"frame": "ENU, metres", "created": CREATED, "Ort": "Zürich 🏔"}
    assert before == {"frame": "ENU, metres"}
    with pytest.raises(TypeError, match="does not support item assignment"):
        scene.metadata["frame"] = "ECEF"  # type: ignore[index]
    scene.metadata = {}
    assert not scene.metadata


@pytest.mark.parametrize(
    ("metadata", "error", "message"),
    [
        ({"x": 1}, TypeError, "names and texts must be str, not 'x': 1"),
        ({1: "x"}, TypeError, "names and texts must be str, not 1: 'x'"),
        ({"x": None}, TypeError, "not 'x': None"),
        ({"created": "yesterday"}, ValueError, "must be a time in UTC .* not 'yesterday'"),
        ({"x": "\ud800"}, ValueError, "surrogates not allowed"),
        (3, TypeError, "not iterable"),
        ({"": "x"}, ValueError, "a name has 1 to 128 bytes, not 0"),
        ({"x": "ü" * 40_000}, ValueError, "'x' has 80000 bytes, at most 65536"),
        ({str(i): "" for i in range(257)}, ValueError, "at most 256 names, not 257"),
    ],
)
def test_what_is_refused(
    scene: pm.PrototypeMap, metadata: Any, error: type[Exception], message: str
) -> None:
    scene.metadata = {"frame": "ENU"}
    with pytest.raises(error, match=message):
        scene.metadata = metadata
    assert scene.metadata == {"frame": "ENU"}


def test_equal_maps_give_equal_files(encoder: pm.Encoder, tmp_path: Path) -> None:
    descriptors = random_descriptors(20)
    files = []
    for order in (1, -1):
        scene = pm.PrototypeMap(encoder)
        scene.add(np.arange(20)[::order], descriptors[::order])
        scene.metadata = dict([("b", "2"), ("a", "1"), ("ab", "3")][::order])
        scene.save(tmp_path / "scene.pmk")
        scene.seal(tmp_path / "sealed.pmk")
        files.append([(tmp_path / name).read_bytes() for name in ("scene.pmk", "sealed.pmk")])
    assert files[0] == files[1]


def test_it_goes_along(scene: pm.PrototypeMap, encoder: pm.Encoder, tmp_path: Path) -> None:
    scene.metadata = {"frame": "ENU, metres", "created": CREATED}
    sealed = scene.seal(tmp_path / "sealed.pmk")
    assert sealed.metadata == scene.metadata
    with pytest.raises(AttributeError):
        sealed.metadata = {}  # type: ignore[misc]
    scene.save(tmp_path / "scene.pmk")
    assert pm.open(tmp_path / "scene.pmk").metadata == scene.metadata
    earlier = pm.PrototypeMap(encoder)
    earlier.metadata = {"frame": "ECEF", "created": "2020-01-01T00:00:00Z", "robot": "atlas-2"}
    scene.merge_map(earlier)
    assert scene.metadata == {
        "frame": "ENU, metres",
        "created": "2020-01-01T00:00:00Z",
        "robot": "atlas-2",
    }


def test_its_section_is_as_documented(scene: pm.PrototypeMap, tmp_path: Path) -> None:
    """An older reader, without this section, reads all other sections."""
    path = tmp_path / "scene.pmk"
    scene.save(path)
    without = path.read_bytes()
    scene.metadata = {"frame": "ENU", "a": "ü"}
    scene.save(path)
    parts = sections(path.read_bytes())
    assert dict(parts)["metadata"] == (
        b"\x01\0\0\0a\x02\0\0\0\xc3\xbc" + b"\x05\0\0\0frame\x03\0\0\0ENU"
    )
    # Same version, same sections otherwise; sections with other names are skipped.
    assert path.read_bytes()[8:12] == without[8:12] == b"\x01\0\0\0"
    assert [part for part in parts if part[0] != "metadata"] == sections(without)
    renamed = [("later" if name == "metadata" else name, content) for name, content in parts]
    path.write_bytes(container(renamed, version=1, kind=2))
    read = pm.open(path)
    assert isinstance(read, pm.PrototypeMap)
    read.save(path)
    assert path.read_bytes() == without


def test_broken_metadata_is_refused(scene: pm.PrototypeMap, tmp_path: Path) -> None:
    path = tmp_path / "sealed.pmk"
    scene.metadata = {"a": "b"}
    scene.seal(path)
    for content in (b"\x01\0\0\0a", b"\x01\0\0\0a\x01\0\0\0\xff", b"\x01\0\0\0a\xff\xff\xff\xffb"):
        parts = [(n, content if n == "metadata" else c) for n, c in sections(path.read_bytes())]
        (tmp_path / "broken.pmk").write_bytes(container(parts, version=1, kind=SEALED_MAP))
        with pytest.raises(pm.FileError, match=r"broken\.pmk: its section 'metadata'"):
            pm.open(tmp_path / "broken.pmk")


@pytest.mark.parametrize("kind", ["learning", "sealed"])
def test_the_expected_encoder(
    kind: str, scene: pm.PrototypeMap, encoder: pm.Encoder, tmp_path: Path
) -> None:
    path = tmp_path / "scene.pmk"
    (scene.save if kind == "learning" else scene.seal)(path)
    encoder.save(tmp_path / "copy.pme")
    for expected in (None, encoder, pm.Encoder.load(tmp_path / "copy.pme")):
        assert len(pm.open(path, encoder=expected, descriptor="test")) == len(scene)
    message = (
        rf"scene\.pmk: it was made with encoder 'tiny' \(identity {encoder.identity[:12]}\), "
        r"not with 'other' \(identity "
    )
    with pytest.raises(ValueError, match=message):
        pm.open(path, encoder=other_encoder())
    with pytest.raises(
        ValueError, match=r"scene\.pmk: it is a map of test descriptors, not of orb"
    ):
        pm.open(path, descriptor="orb")


def test_build_says_when_and_what(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from protomark import sample

    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    build = ("build", sample.path(), "--frame", "ENU, metres", "--metadata", "robot=atlas=2")
    for name in ("a.pmk", "b.pmk"):
        done = protomark(*build, "-o", tmp_path / name, "--json", tmp_path / "facts.json")
        assert done.returncode == 0, done.stderr
    expected = {
        "created": "2023-11-14T22:13:20Z",
        "frame": "ENU, metres",
        "robot": "atlas=2",
        "cameras": f"1 {sample.load().cameras[1]}\n",
    }
    metadata = dict(pm.open(tmp_path / "a.pmk").metadata)
    facts = json.loads((tmp_path / "facts.json").read_text())
    assert facts["metadata"] == metadata
    assert json.loads(metadata.pop("sources")) == facts["sources"]
    assert [(one["name"], one["landmarks"]) for one in facts["sources"]] == [
        (sample.path().name, len(sample.load().landmark_ids))
    ]
    assert metadata == expected
    assert "ENU, metres" in done.stdout
    assert (tmp_path / "a.pmk").read_bytes() == (tmp_path / "b.pmk").read_bytes()
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "soon")
    done = protomark(*build, "-o", tmp_path / "c.pmk")
    assert done.returncode == 1, done.stderr
    assert "SOURCE_DATE_EPOCH" in done.stderr
    monkeypatch.delenv("SOURCE_DATE_EPOCH")
    done = protomark("build", sample.path(), "-o", tmp_path / "c.pmk", "--metadata", "robot")
    assert done.returncode == 1
    assert "--metadata 'robot' is not of the form NAME=TEXT" in done.stderr
