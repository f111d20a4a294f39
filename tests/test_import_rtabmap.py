"""Databases of RTAB-Map: written ones, some of the program itself, and broken ones."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import protomark as pm
from foreign_scene import (
    assert_same,
    check_broken_files,
    counts,
    foreign,
    orb_tracks,
    reprojection_errors,
)
from protomark.geometry.pose import rotation_from_quaternion
from protomark.maps.build import build_map
from protomark.maps.places import places_text
from protomark.maps.sources import read_places
from protomark.tracks.file import Tracks
from protomark.tracks.importers.rtabmap import read, recognizes
from rtabmap_writer import VERSIONS, write_rtabmap

DRIFT = np.column_stack(
    [rotation_from_quaternion(np.array([0.98, 0.1, -0.1, 0.14])), [1.0, -2.0, 0.5]]
)


def gftt_tracks(count: int = 4) -> Tracks:
    """Upright keypoints of one scale, and words from 1 on."""
    tracks = orb_tracks(count=count)
    label = np.where(tracks.landmark_of_keypoint < 0, -1, tracks.landmark_of_keypoint + 1)
    n = len(label)
    return replace(
        tracks,
        landmark_of_keypoint=label,
        landmark_ids=tracks.landmark_ids + 1,
        sizes=np.full(n, 3, np.float32),
        angles=np.full(n, -1, np.float32),
        octaves=np.zeros(n, np.int32),
    )


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("version", VERSIONS)
def test_what_was_written_is_read(version: str, cameras: int, tmp_path: Path) -> None:
    path, tracks = tmp_path / "map", gftt_tracks()
    if version == VERSIONS[0]:
        # A word has the descriptor of its first feature; features have none of their own.
        first = np.unique(tracks.landmark_of_keypoint, return_index=True)
        tracks.descriptors = tracks.descriptors[
            first[1][np.searchsorted(first[0], tracks.landmark_of_keypoint)]
        ]
    write_rtabmap(path, tracks, version, cameras)
    assert recognizes(path, path.read_bytes()[:4096])
    found = read(path)
    if version == VERSIONS[0]:  # it does not say how large images are
        found.cameras = {1: tracks.cameras[1]}
    assert_same(found, tracks, 0.01)
    assert np.abs(reprojection_errors(found)).max() < 0.02
    assert found.keyframe_names[1] == ("node1" if cameras == 1 else "node0/camera1")
    assert found.info["source"]["version"] == version
    assert not found.info["source"]["dropped"]
    detector = {"name": "GFTT/ORB", "max_features": 500.0, "quality_level": 0.001, "levels": 3.0}
    assert found.info["detector"] == detector
    assert found.encoder_name == "orb-gftt"
    assert len(build_map(found, pm.Encoder.load(found.encoder_name))) > 100


@pytest.mark.parametrize("version", ["0.17.0", "0.23.0"])
def test_stereo_camera(version: str, tmp_path: Path) -> None:
    tracks = gftt_tracks()
    write_rtabmap(tmp_path / "map.db", tracks, version, stereo=True)
    assert_same(read(tmp_path / "map.db"), tracks, 0.01)


def test_poses_of_the_optimized_graph(tmp_path: Path) -> None:
    tracks = gftt_tracks()
    write_rtabmap(tmp_path / "map.db", tracks, drift=DRIFT)
    found = read(tmp_path / "map.db")
    # The last node is not in the graph, but odometry connects it.
    assert_same(found, tracks, 0.01)
    assert [m["keyframes"] for m in found.info["source"]["maps"]] == [4]


def test_sessions_that_nothing_connects_are_maps_of_their_own(tmp_path: Path) -> None:
    tracks = gftt_tracks()
    write_rtabmap(tmp_path / "map.db", tracks, sessions=2)
    found = read(tmp_path / "map.db")
    half = int(found.offsets[2])
    first, second = (
        set(found.landmark_of_keypoint[s].tolist()) - {-1} for s in (slice(half), slice(half, None))
    )
    assert not first & second
    assert {i % 2**32 for i in first | second} == set(tracks.landmark_ids.tolist())
    maps = found.info["source"]["maps"]
    assert [m["keyframes"] for m in maps] == [2, 2]
    assert [m["ids"] for m in maps] == [[min(ids), max(ids)] for ids in (first, second)]
    assert max(first) < min(second)
    places = json.loads(places_text(read_places([tmp_path / "map.db"]).info["sources"]))
    assert [name for name, *_ in places] == ["map.db, map 1", "map.db, map 2"]
    assert len(found.observations) == len(tracks.observations)


def test_a_word_at_two_places_is_two_landmarks(tmp_path: Path) -> None:
    path, tracks = tmp_path / "map.db", gftt_tracks()
    write_rtabmap(path, tracks)
    ids, seen = np.unique(tracks.landmark_of_keypoint, return_counts=True)
    a, b, c = (int(i) for i in ids[seen == 4][:3])
    connection = sqlite3.connect(path)
    move = (
        "UPDATE Feature SET depth_x = {0} * depth_x, depth_y = {0} * depth_y, "
        "depth_z = {0} * depth_z WHERE word_id = {1} AND node_id {2}"
    )
    # One word is seen elsewhere from one node; one between two places; one twice in a node.
    connection.execute(move.format(1.5, a, "= 3"))
    connection.execute(move.format(1.08, b, "= 1"))
    connection.execute(move.format(1.04, b, "= 2"))
    connection.execute(
        "INSERT INTO Feature SELECT node_id, word_id, pos_x + 9, pos_y, size, dir, response, "
        "octave, depth_x + 0.001, depth_y, depth_z, descriptor_size, descriptor FROM Feature "
        f"WHERE word_id = {c} AND node_id = 0"
    )
    connection.commit()
    connection.close()
    found = read(path)
    label = found.landmark_of_keypoint
    assert (label == a).sum() == 3
    assert (label == a + 2**32).sum() == 1
    assert (label == b).sum() == 2
    assert (label == b + 2**32).sum() == 1
    assert (label == c).sum() == 4
    assert found.info["source"]["dropped"] == {
        "observations of words that are at two places": 1,
        "observations of a landmark twice in a keyframe": 1,
    }


@pytest.mark.parametrize(
    ("sql", "problem"),
    [
        ("DELETE FROM Feature", "has 4 nodes, but no features with descriptors"),
        (
            "UPDATE Feature SET descriptor = zeroblob(256), descriptor_size = 64",
            r"float descriptors \(SURF\)",
        ),
        (
            "UPDATE Feature SET descriptor = zeroblob(128)",
            r"float descriptors.*record it with Kp/Det",
        ),
        (
            "UPDATE Data SET calibration = NULL",
            "no node with features has a pose and a calibration",
        ),
        ("UPDATE Node SET pose = zeroblob(48)", "no node with features has a pose"),
        ("UPDATE Feature SET descriptor = x'00' WHERE node_id = 2", "descriptors of .* bytes"),
        ("UPDATE Admin SET opt_ids = zeroblob(12), opt_poses = zeroblob(7)", "database: .*buffer"),
        ("UPDATE Data SET calibration = zeroblob(1000)", "node 0: .* save the map anew"),
    ],
)
def test_what_cannot_be_read(sql: str, problem: str, tmp_path: Path) -> None:
    path = tmp_path / "map.db"
    write_rtabmap(path, gftt_tracks(), strategy=0)
    connection = sqlite3.connect(path)
    connection.execute(sql)
    connection.commit()
    connection.close()
    with pytest.raises(ValueError, match=rf"map\.db.*{problem}"):
        read(path)


@pytest.mark.parametrize("version", [VERSIONS[2], VERSIONS[5]])
def test_broken_databases(version: str, tmp_path: Path) -> None:
    path = tmp_path / "map.db"
    write_rtabmap(path, gftt_tracks(2), version, drift=DRIFT)
    check_broken_files(path, read, tmp_path)


def test_a_database_of_the_program(tmp_path: Path) -> None:
    path = foreign("rtabmap/mdc_ubuntu.db")
    assert recognizes(path, path.read_bytes()[:4096])
    found = read(path)
    assert counts(found)[::3] == (13, 5106)
    assert len(found.observations) > 3500
    assert found.info["source"]["version"] == "0.21.10"
    assert found.info["detector"]["name"] == "GFTT/ORB"
    # Single observations have no error but that of conventions, of which there is none.
    assert np.percentile(np.abs(reprojection_errors(found)), 60) < 1e-3
    check_broken_files(path, read, tmp_path, 60)


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("strroke21_rtabmap", "has 411 nodes, but no features"),
        ("brubaker", "0.20.7 is empty"),
        ("vijayg", "0.22.1 is empty"),
    ],
)
def test_databases_without_features(name: str, problem: str) -> None:
    path = foreign(f"rtabmap/{name}.db")
    assert recognizes(path, path.read_bytes()[:4096])
    with pytest.raises(ValueError, match=problem):
        read(path)
