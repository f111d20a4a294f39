"""Maps built of several sources, and of COLMAP databases with their model."""

from __future__ import annotations

import json
import lzma
from pathlib import Path

import numpy as np
import pytest

import protomark as pm
from conftest import protomark
from protomark import sample
from protomark.geometry.colmap import ColmapModel
from protomark.maps.origin import joint_origin, map_detector, source_rows
from protomark.maps.places import map_places, places_text
from protomark.maps.sources import find_sources, read_places
from protomark.tracks.database import read_features, tracks_from_database
from protomark.tracks.file import Tracks
from protomark.tracks.matching import View, match
from protomark.tracks.triangulation import triangulate
from tracks_scene import write_sequence

DATABASES = sorted((Path(__file__).parent / "data" / "colmap").glob("*.db.xz"))


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A COLMAP model of the three images of the databases, by their ORB keypoints."""
    folder = tmp_path_factory.mktemp("toy3")
    toy = sample.load()
    database = unpacked(DATABASES[0], folder)
    features = read_features(database, "orb")
    rows = [toy.keyframe_names.index(name) for name in features]
    poses = toy.cam_from_world[rows]
    posed = ColmapModel(
        toy.cameras, list(features), np.arange(1, 4), toy.keyframe_camera[rows], poses, []
    )
    camera = toy.cameras[int(toy.keyframe_camera[0])]
    views = [
        View(f.descriptors, camera.rays(f.keypoints), pose, camera.focal_length)
        for f, pose in zip(features.values(), poses, strict=True)
    ]
    pairs = {(i, j): match(views[i], views[j], 0.9, 3.0) for i in range(3) for j in range(i + 1, 3)}
    keypoints = [f.keypoints for f in features.values()]
    reconstruction = triangulate(posed, keypoints, pairs, 3.0, 1.0)
    (folder / "sparse").mkdir()
    reconstruction.write(str(folder / "sparse"))
    return folder / "sparse"


def unpacked(packed: Path, folder: Path) -> Path:
    path = folder / packed.stem
    path.write_bytes(lzma.decompress(packed.read_bytes()))
    return path


@pytest.mark.parametrize("packed", DATABASES, ids=lambda path: path.stem)
def test_databases_by_columns_and_not_by_type(packed: Path, model: Path, tmp_path: Path) -> None:
    """COLMAP 4 calls the ORB descriptors of an older database SIFT when it opens that."""
    database = unpacked(packed, tmp_path)
    found = read_places([database, model])
    assert found.descriptor == "orb"
    assert len(tracks_from_database(database, model, "orb").keypoints) == 900
    assert (found.landmark_of_keypoint >= 0).all()
    assert len(found.landmark_ids) > 50
    (facts,) = found.info["sources"]
    assert facts["program"] == "COLMAP"
    assert facts["version"] in ("3900", "4020100")
    done = protomark("build", model, database, "-o", tmp_path / "scene.pmk")
    assert done.returncode == 0, done.stderr
    assert "COLMAP" in done.stdout
    assert len(pm.open(tmp_path / "scene.pmk")) == len(found.landmark_ids)
    assert len(DATABASES) == 5


def test_databases_of_other_descriptors(model: Path, tmp_path: Path) -> None:
    import sqlite3

    database = unpacked(DATABASES[0], tmp_path)
    for cols, message in (
        (128, "do not fit together"),
        (64, "freak, brisk, beblid with --encoder"),
    ):
        connection = sqlite3.connect(database)
        connection.execute("UPDATE descriptors SET cols = ?", (cols,))
        connection.commit()
        connection.close()
        with pytest.raises(ValueError, match=message):
            read_places([database, model])


def test_images_with_their_model(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "plane", count=5)
    first, second = folder / "images", folder / "sparse"
    by_folder = read_places([folder], "orb")
    by_parts = read_places([second, first], "orb")
    assert np.array_equal(by_folder.descriptors, by_parts.descriptors)
    assert [s.name for s in find_sources([first, second])] == ["plane"]
    for lonely in (first, second):
        with pytest.raises(ValueError, match=f"{lonely.name} (holds images|is a COLMAP model)"):
            find_sources([lonely, sample.path()])
    # What should have been the other half is to blame if it is nothing that can be read.
    (cut := tmp_path / "cut.db").write_bytes(b"SQLite format 3\0" + bytes(500))
    for pair in ([cut, second], [second, cut]):
        with pytest.raises(ValueError, match=r"cut\.db is a database that is cut off, broken"):
            find_sources(pair)


def test_places_get_ids_apart_whatever_their_order(tmp_path: Path) -> None:
    toy = sample.load()
    later = toy.landmark_ids >= 2000
    toy.save(tmp_path / "b.safetensors")
    half = Tracks(**{**vars(toy), "landmark_ids": toy.landmark_ids[later]})
    half.landmark_positions = toy.landmark_positions[later]
    half.landmark_of_keypoint = np.where(
        toy.landmark_of_keypoint >= 2000, toy.landmark_of_keypoint, -1
    )
    half.info = {**toy.info, "detector": {"name": "ORB-SLAM", "levels": 4}}
    half.save(tmp_path / "a.safetensors")
    paths = [tmp_path / "b.safetensors", tmp_path / "a.safetensors"]
    joined = read_places(paths)
    joined.check()
    top = int(toy.landmark_ids[-1])
    assert [one["ids"] for one in joined.info["sources"]] == [[2000, top], [top + 1, 2 * top + 1]]
    assert joined.keyframe_names[0] == f"a.safetensors/{toy.keyframe_names[0]}"
    other = read_places(paths[::-1])
    for name in ("landmark_ids", "landmark_of_keypoint", "descriptors", "landmark_positions"):
        assert np.array_equal(getattr(joined, name), getattr(other, name))
    counts = np.unique(toy.landmark_of_keypoint[toy.observations], return_counts=True)[1]
    (long,) = read_places([sample.path()], min_observations=4).info["sources"]
    assert long["dropped"] == {"landmarks of fewer observations than 4": (counts < 4).sum()}
    files = []
    for order in (1, -1):
        path = tmp_path / f"{order}.pmk"
        done = protomark(
            "build", *paths[::order], "-o", path, "--metadata", "created=2026-11-30T00:00:00Z"
        )
        assert done.returncode == 0, done.stderr
        files.append(path.read_bytes())
    assert files[0] == files[1]
    scene = pm.open(path)
    assert map_detector(scene) == {}  # they differ
    assert len(scene) == len(half.landmark_ids) + len(toy.landmark_ids)
    assert [name for name, _ in source_rows(scene.metadata)] == [
        "source: a.safetensors",
        "source: b.safetensors",
    ]


def test_what_is_refused(tmp_path: Path) -> None:
    other = sample.load()
    other.descriptor = "latch"
    other.descriptors = other.descriptors[:, :32].copy()
    other.save(tmp_path / "latch.safetensors")
    with pytest.raises(
        ValueError, match=r"freak descriptors, but others have latch: a map holds one"
    ):
        read_places([sample.path(), tmp_path / "latch.safetensors"])
    with pytest.raises(ValueError, match="is named twice"):
        read_places([sample.path(), sample.path()])
    for name, content, message in (
        ("cut.db", b"SQLite format 3\0 and no more", "cut.db is a database that is cut off"),
        ("a.keyframes", b"\0", "a.keyframes is a part of a map that osmap saved"),
        ("a.pmk", b"PROTOMRK", "a.pmk is what Protomark wrote already"),
        ("rigs.json", b'[{"cameras": [{"camera_id": 1}]}]', "rigs.json is no map"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=message):
            read_places([tmp_path / name])
    (tmp_path / "x.bin").write_bytes(b"nothing known")
    with pytest.raises(ValueError, match=r"x\.bin is no map that can be read.*ORB-SLAM3"):
        read_places([tmp_path / "x.bin"])
    with pytest.raises(FileNotFoundError, match="no such file or folder"):
        read_places([tmp_path / "y.bin"])


def test_a_landmark_of_one_observation(tmp_path: Path) -> None:
    """Is left out, unless its source has no other."""
    toy = sample.load()
    single = toy.where(toy.keyframe_of_keypoint == 0)
    single.save(tmp_path / "single.safetensors")
    found = read_places([sample.path(), tmp_path / "single.safetensors"])
    assert len(found.observations) == len(toy.observations) + len(single.observations)
    with pytest.raises(ValueError, match=r"single.*no landmark has 2 observations"):
        read_places([tmp_path / "single.safetensors"], min_observations=2)


def test_merged_maps_have_both_origins() -> None:
    first = {"sources": json.dumps([{"name": "a", "ids": [0, 5]}]), "detector": '{"levels": 4}'}
    second = {"sources": json.dumps([{"name": "b", "ids": [0, 7], "maps": [{"ids": [1, 2]}]}])}
    texts = joint_origin(first, second, 6)
    assert json.loads(texts["sources"]) == [
        {"name": "a", "ids": [0, 5]},
        {"name": "b", "ids": [6, 13], "maps": [{"ids": [7, 8]}]},
    ]
    assert texts["detector"] == "{}"
    assert joint_origin(first, first)["sources"] == first["sources"]
    assert joint_origin({}, {}) == {}
    databases = [{"detector": json.dumps({"name": "COLMAP", "max_keypoints": n})} for n in (5, 9)]
    joint = joint_origin(*databases)["detector"]
    assert json.loads(joint) == {"name": "COLMAP", "max_keypoints": 9}


def test_places_of_a_map() -> None:
    sources = [
        {"name": "a", "ids": [3, 9], "maps": [{"id": 0, "ids": [3, 5]}, {"id": 2, "ids": [6, 9]}]},
        {"name": "b", "ids": [10, 11], "maps": [{"id": 0}]},
    ]
    text = places_text(sources)
    places = map_places({"places": text})
    assert [(p.name, p.first, p.last) for p in places] == [
        ("a, map 0", 3, 5),
        ("a, map 2", 6, 9),
        ("b", 10, 11),
    ]
    assert places[1].holds(np.array([5, 6, 9, 10])).tolist() == [False, True, True, False]
    assert places_text(sources[1:]) == ""
    assert map_places({}) == []
    for wrong in ("x", "[[1]]", '[["a", 0, 5], ["b", 5, 6]]', '[["a", 2, 1]]', '{"a": 1}', "3"):
        with pytest.raises(ValueError, match="hold no list of name, first and last id"):
            map_places({"places": wrong})
    with pytest.raises(ValueError, match="several places, each with coordinates of its own"):
        joint_origin({"places": text}, {})
    assert joint_origin({"places": text}, {"places": text}) == {}
