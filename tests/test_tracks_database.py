"""Tracks from a COLMAP database with binary descriptors and from its model."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
import pytest

from protomark.geometry.colmap import pycolmap, read_model
from protomark.tracks.database import provenance, tracks_from_database
from protomark.tracks.extract import TracksOptions, extract, find_sequence
from protomark.tracks.file import Tracks
from protomark.tracks.triangulation import _posed, _write_database
from tracks_scene import write_sequence


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Tracks]:
    """A database and a model with points in COLMAP's own files, and the tracks they came from."""
    folder = write_sequence(tmp_path_factory.mktemp("database") / "plane", count=5)
    tracks = extract(find_sequence(folder), TracksOptions("orb", max_keypoints=300))
    model = read_model(folder / "sparse")
    keypoints = [tracks.keypoints[tracks.keypoints_of(i)] for i in range(5)]
    reconstruction = _posed(model, keypoints)
    _write_database(folder / "database.db", reconstruction, keypoints, {})
    connection = sqlite3.connect(folder / "database.db")
    for i in range(5):
        rows = tracks.descriptors[tracks.keypoints_of(i)]
        scale = tracks.sizes[tracks.keypoints_of(i)] / 2
        turn = np.radians(tracks.angles[tracks.keypoints_of(i)])
        shape = np.column_stack([keypoints[i], scale, turn]).astype("<f4")
        columns = [c[1] for c in connection.execute("PRAGMA table_info(descriptors)")]
        values = {"image_id": i + 1, "rows": len(rows), "cols": 32, "data": rows.tobytes()}
        values |= {c: 0 for c in columns if c not in values}
        marks = ", ".join("?" * len(columns))
        connection.execute(
            f"INSERT INTO descriptors ({', '.join(columns)}) VALUES ({marks})",
            [values[c] for c in columns],
        )
        connection.execute(
            "UPDATE keypoints SET cols = 4, data = ? WHERE image_id = ?", (shape.tobytes(), i + 1)
        )
    connection.commit()
    connection.close()
    keyframe = tracks.keyframe_of_keypoint
    for landmark, xyz in zip(tracks.landmark_ids, tracks.landmark_positions, strict=True):
        track = pycolmap.Track()
        for row in np.flatnonzero(tracks.landmark_of_keypoint == landmark):
            i = int(keyframe[row])
            track.add_element(i + 1, int(row - tracks.offsets[i]))
        reconstruction.add_point3D(xyz, track, np.zeros(3, np.uint8))
    (folder / "points").mkdir()
    reconstruction.write(str(folder / "points"))
    return folder, tracks


def test_same_tracks_as_went_in(scene: tuple[Path, Tracks], tmp_path: Path) -> None:
    folder, tracks = scene
    found = tracks_from_database(folder / "database.db", folder / "points", "orb", "plane")
    for name in ("descriptors", "keypoints", "landmark_of_keypoint", "offsets", "landmark_ids"):
        assert np.array_equal(getattr(found, name), getattr(tracks, name)), name
    assert np.allclose(found.landmark_positions, tracks.landmark_positions)
    assert np.allclose(found.sizes, tracks.sizes, rtol=1e-6)
    assert np.allclose(found.angles, tracks.angles, atol=1e-3)
    assert found.keyframe_names == tracks.keyframe_names
    inputs = (folder / "database.db", folder / "points")
    expected = provenance(*inputs, "orb")
    assert expected != provenance(*inputs, "latch")
    assert {key: found.info[key] for key in expected} == expected


def change(scene: tuple[Path, Tracks], tmp_path: Path, sql: str) -> Path:
    path = tmp_path / "changed.db"
    path.write_bytes((scene[0] / "database.db").read_bytes())
    connection = sqlite3.connect(path)
    connection.execute(sql)
    connection.commit()
    connection.close()
    return path


def test_reading_writes_nothing(scene: tuple[Path, Tracks], tmp_path: Path) -> None:
    """COLMAP's databases are in a mode in which even a reader needs to write files beside them."""
    path = change(scene, tmp_path, "PRAGMA journal_mode = WAL")
    tmp_path.chmod(0o555)
    found = tracks_from_database(path, scene[0] / "points", "orb")
    tmp_path.chmod(0o755)
    assert np.array_equal(found.descriptors, scene[1].descriptors)
    assert [p.name for p in tmp_path.iterdir()] == ["changed.db"]


def test_a_database_that_is_being_written(scene: tuple[Path, Tracks], tmp_path: Path) -> None:
    path = change(scene, tmp_path, "PRAGMA journal_mode = DELETE")
    writer = sqlite3.connect(path, isolation_level=None)
    writer.execute("BEGIN EXCLUSIVE")
    writer.execute("UPDATE images SET name = name || 'x'")
    with pytest.raises(ValueError, match=r"changed\.db is locked: another process writes to it"):
        tracks_from_database(path, scene[0] / "points", "orb")
    writer.execute("ROLLBACK")
    writer.close()
    assert len(tracks_from_database(path, scene[0] / "points", "orb").keypoints)


def test_other_descriptor(scene: tuple[Path, Tracks]) -> None:
    with pytest.raises(ValueError, match=r"32 bytes, but freak has 64.*orb or latch or teblid"):
        tracks_from_database(scene[0] / "database.db", scene[0] / "points", "freak")


def test_model_without_points(scene: tuple[Path, Tracks]) -> None:
    with pytest.raises(ValueError, match=r"no points.*without --database"):
        tracks_from_database(scene[0] / "database.db", scene[0] / "sparse", "orb")


def test_image_that_the_database_lacks(scene: tuple[Path, Tracks], tmp_path: Path) -> None:
    path = change(scene, tmp_path, "DELETE FROM images WHERE name = 'img2.png'")
    with pytest.raises(ValueError, match=r"img2.png"):
        tracks_from_database(path, scene[0] / "points", "orb")


def test_database_of_another_model(scene: tuple[Path, Tracks], tmp_path: Path) -> None:
    sql = "DELETE FROM {} WHERE image_id = 1"
    path = change(scene, tmp_path, sql.format("keypoints"))
    with pytest.raises(ValueError, match=r"do not fit together"):
        tracks_from_database(path, scene[0] / "points", "orb")
    connection = sqlite3.connect(path)
    connection.execute(sql.format("descriptors"))
    connection.commit()
    connection.close()
    with pytest.raises(ValueError, match=r"img1.png has 0 keypoints.*the database of this model"):
        tracks_from_database(path, scene[0] / "points", "orb")


def test_cut_off_blob(scene: tuple[Path, Tracks], tmp_path: Path) -> None:
    path = change(
        scene, tmp_path, "UPDATE descriptors SET data = substr(data, 1, 99) WHERE image_id = 3"
    )
    with pytest.raises(ValueError, match=r"img3.png.*do not fit together"):
        tracks_from_database(path, scene[0] / "points", "orb")


def test_not_a_database(scene: tuple[Path, Tracks], tmp_path: Path) -> None:
    path = tmp_path / "x.db"
    with pytest.raises(FileNotFoundError, match=r"x.db"):
        tracks_from_database(path, scene[0] / "points", "orb")
    path.write_bytes(b"nonsense" * 100)
    with pytest.raises(ValueError, match=r"not a COLMAP database"):
        tracks_from_database(path, scene[0] / "points", "orb")
    path.write_bytes((scene[0] / "database.db").read_bytes()[:20000])
    with pytest.raises(ValueError, match=r"not a COLMAP database|do not fit|not in the database"):
        tracks_from_database(path, scene[0] / "points", "orb")
