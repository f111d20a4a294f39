"""Maps of stella_vslam: written files, files of the program itself, and broken ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import protomark as pm
from foreign_scene import (
    PINHOLE,
    assert_same,
    check_broken_files,
    counts,
    foreign,
    orb_tracks,
    reprojection_errors,
)
from protomark.geometry.camera import Camera
from protomark.maps.build import build_map
from protomark.tracks.importers.messagepack import Unpacker
from protomark.tracks.importers.stella import read, recognizes
from stella_writer import VERSIONS, pack, write_db, write_msg

LENS = (620.0, 618.0, 640.5, 482.5)
CAMERAS = (
    PINHOLE,
    Camera("OPENCV", 1280, 964, (*LENS, -0.1, 0.01, 1e-3, -2e-3)),
    Camera("FULL_OPENCV", 1280, 964, (*LENS, -0.1, 0.02, 1e-3, -2e-3, -0.002, 0.0, 0.0, 0.0)),
    Camera("OPENCV_FISHEYE", 1280, 964, (*LENS, 0.01, -0.002, 0.001, -0.0003)),
    Camera("DIVISION", 1280, 964, (*LENS, -0.12)),
    Camera("EQUIRECTANGULAR", 1280, 640, (1280.0, 640.0)),
)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.model)
@pytest.mark.parametrize("version", ["db", *VERSIONS])
def test_what_was_written_is_read(version: str, camera: Camera, tmp_path: Path) -> None:
    tracks = orb_tracks(camera)
    # What a file is, its content says and not its name.
    path = tmp_path / ("map.msg" if version == "db" else "map.db")
    if version == "db":
        write_db(path, tracks)
    else:
        write_msg(path, tracks, version)
    assert recognizes(path, path.read_bytes()[:4096])
    found = read(path)
    assert_same(found, tracks, 0.02)
    assert np.abs(reprojection_errors(found)).max() < 0.05
    assert found.info["source"]["program"] == "stella_vslam"
    assert found.info["source"]["version"] == ("unknown" if version == "db" else version)
    assert "dropped" not in found.info["source"]
    if version == VERSIONS[-1]:
        assert found.info["detector"]["levels"] == 8
    assert len(build_map(found, pm.Encoder.load("orb"))) > 100


def test_a_program_that_is_not_stella(tmp_path: Path) -> None:
    for data in (b"", b"\x81\xa3abc\x01", b"SQLite format 3\0", b"{}", b"\x86"):
        path = tmp_path / "other"
        path.write_bytes(data)
        assert not recognizes(path, data)


@pytest.mark.parametrize("kind", ["msg", "db"])
def test_empty_map(kind: str, tmp_path: Path) -> None:
    tracks = orb_tracks(count=0)
    path = tmp_path / f"map.{kind}"
    (write_db if kind == "db" else write_msg)(path, tracks)
    with pytest.raises(ValueError, match=r"this map of stella_vslam is empty: save it after"):
        read(path)


def test_observations_that_do_not_fit_are_counted(tmp_path: Path) -> None:
    tracks = orb_tracks()
    seen = tracks.observations
    label = tracks.landmark_of_keypoint.copy()
    label[seen[0]], label[seen[2]] = 10**6, label[seen[1]]
    tracks.landmark_of_keypoint = label
    write_msg(tmp_path / "map.msg", tracks)
    found = read(tmp_path / "map.msg")
    assert found.info["source"]["dropped"] == {
        "observations of missing landmarks": 1,
        "observations of a landmark twice in a keyframe": 1,
    }
    assert len(found.observations) == len(seen) - 2


@pytest.mark.parametrize("kind", ["msg", "db"])
def test_broken_maps(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"map.{kind}"
    (write_db if kind == "db" else write_msg)(path, orb_tracks(CAMERAS[1], 2))
    check_broken_files(path, read, tmp_path)


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"\x81\xa7cameras\xdf\xff\xff\xff\xff", "4,294,967,295 items of a map"),
        (b"\x81\xa7cameras\x81\xa1c\xdd\xff\xff\xff\xff", "items of a list"),
        (b"\x81\xa7cameras" + b"\x91" * 100_000, "nested too deeply"),
        (b"\x81\xa9keyframes\x81\xa10\x81\xa5descs\x91" + b"\x91" * 100_000, "nested too deeply"),
        (b"\x81\xa9keyframes\x81\xa10\x81\xa5descs\x92\x90\x90", "do not hold the same numbers"),
        (b"\x81\xa9keyframes\x81\xa10\x81\xa5descs\x92\x91\x01\x92\x01\x01", "the same numbers"),
        (b"\x81\xa9keyframes\x81\xa10\x81\xa5descs\x91\xa1a", "something else than numbers"),
        (b"\x81\xa9keyframes\x81\xa10\x81\xa6lm_ids\xda\xff", "should follow"),
        (b"\x81\xa7cameras\x81\xa1c\xc1", "should be here"),
    ],
)
def test_malicious_data(data: bytes, problem: str, tmp_path: Path) -> None:
    path = tmp_path / "map.msg"
    path.write_bytes(data)
    with pytest.raises(ValueError, match=problem):
        read(path)


def test_tables_of_numbers_of_all_kinds() -> None:
    rng = np.random.default_rng(0)
    limits = np.array([1, 2**7, 2**8, 2**16, 2**32, 2**50])
    values = [
        {"a": int(rng.integers(-(2**31), 10)), "b": [int(rng.integers(limits[i % 6])), i / 3 - 5]}
        for i in range(500)
    ]
    names, numbers = Unpacker(pack(values), Path("a")).table()
    assert names == [("a",), ("b", 0), ("b", 1)]
    assert numbers.tolist() == [[v["a"], *v["b"]] for v in values]
    assert Unpacker(pack(values), Path("a")).value() == values


@pytest.mark.parametrize(
    ("name", "expected", "error"),
    [
        ("neu_motion_059b237_map.msg", (9, 611, 2707, 19162), 0.8),
        ("neu_motion_059b237_map.by_stella_0.6.db", (9, 611, 2707, 19162), 0.8),
        ("neu_motion_e95da87_map.msg", (5, 512, 1922, 14171), 0.9),
        ("unslam25_map.db.msg", (2, 296, 592, 3305), 0.3),
        ("unslam25_map.by_stella_0.6.db", (2, 296, 592, 3305), 0.3),
    ],
)
def test_maps_of_the_program(
    name: str, expected: tuple[int, int, int, int], error: float, tmp_path: Path
) -> None:
    path = foreign(f"stella_vslam/{name}")
    assert recognizes(path, path.read_bytes()[:4096])
    found = read(path)
    assert counts(found) == expected
    assert "dropped" not in found.info["source"]
    errors = reprojection_errors(found)
    # A wrong half pixel would be a bias.
    assert np.abs(np.median(errors, 0)).max() < 0.05
    assert np.median(np.linalg.norm(errors, axis=1)) < error
    check_broken_files(path, read, tmp_path, 30)


def test_both_files_of_a_map_are_equal() -> None:
    name = "stella_vslam/neu_motion_059b237_map"
    a, b = read(foreign(f"{name}.msg")), read(foreign(f"{name}.by_stella_0.6.db"))
    assert_same(a, b)


@pytest.mark.parametrize("name", ["isro01_openvslam_empty_map.msg", "neu_motion_8ba15d5_map.msg"])
def test_empty_maps_of_the_program(name: str) -> None:
    path = foreign(f"stella_vslam/{name}")
    assert recognizes(path, path.read_bytes()[:4096])
    with pytest.raises(ValueError, match="is empty"):
        read(path)
