"""Real tracks small enough to be written as other programs' maps, and where files of theirs lie."""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mutation import SEED, bounded, mutated
from protomark import sample
from protomark.geometry.camera import Camera
from protomark.geometry.pose import transform
from protomark.tracks.file import Tracks

PINHOLE = Camera("PINHOLE", 1280, 964, (923.8, 920.1, 640.5, 482.5))
SCALE_FACTOR = 1.2


def foreign(name: str) -> Path:
    """A file or folder of real maps, most of which may not be shipped; skips where they are not."""
    beside = Path(__file__).parents[2] / "shared" / "maps"
    path = Path(os.environ.get("PROTOMARK_FOREIGN_MAPS", beside)) / name
    if not path.exists():
        pytest.skip(f"{path}: no such maps, name their folder with PROTOMARK_FOREIGN_MAPS")
    return path


def orb_tracks(camera: Camera = PINHOLE, count: int = 4) -> Tracks:
    """Keyframes of the sample as another camera sees them, with descriptors of 32 bytes.

    Keypoints of landmarks are where the camera sees these exactly; the others stay where they are.
    """
    toy = sample.load()
    keep = toy.keyframe_of_keypoint < count
    n = int(toy.offsets[count])
    toy = replace(
        toy.where(keep),
        keyframe_names=toy.keyframe_names[:count],
        keyframe_camera=toy.keyframe_camera[:count],
        cam_from_world=toy.cam_from_world[:count],
        offsets=toy.offsets[: count + 1],
    )
    xy = (toy.keypoints * np.array([camera.width / 1280, camera.height / 964])).astype(np.float64)
    label = toy.landmark_of_keypoint.copy()
    for i in range(count):
        rows = np.arange(n)[toy.keypoints_of(i)]
        rows = rows[label[rows] >= 0]
        seen = camera.project(transform(toy.cam_from_world[i], toy.positions_of(label[rows])))
        inside = ((seen > 1) & (seen < [camera.width - 1, camera.height - 1])).all(1)
        xy[rows[inside]] = seen[inside]
        label[rows[~inside]] = -1
    ids = np.unique(label[label >= 0])
    return replace(
        toy,
        descriptor="orb",
        cameras={1: camera},
        keypoints=xy.astype(np.float32),
        sizes=(31 * SCALE_FACTOR ** toy.octaves.astype(np.float64)).astype(np.float32),
        descriptors=toy.descriptors[:, :32].copy(),
        landmark_of_keypoint=label,
        landmark_ids=ids,
        landmark_positions=toy.positions_of(ids),
        info={},
    )


def reprojection_errors(tracks: Tracks) -> NDArray[np.float64]:
    """Offsets (n, 2) in pixels of the observations from where their landmarks should be seen."""
    keyframes = tracks.keyframe_of_keypoint
    out = []
    for i in range(len(tracks.keyframe_names)):
        rows = tracks.observations[keyframes[tracks.observations] == i]
        camera = tracks.cameras[int(tracks.keyframe_camera[i])]
        points = tracks.positions_of(tracks.landmark_of_keypoint[rows])
        out.append(
            tracks.keypoints[rows] - camera.project(transform(tracks.cam_from_world[i], points))
        )
    return np.concatenate(out)


def counts(tracks: Tracks) -> tuple[int, int, int, int]:
    """Keyframes, landmarks, observations and keypoints."""
    return (
        len(tracks.keyframe_names),
        len(tracks.landmark_ids),
        len(tracks.observations),
        len(tracks.keypoints),
    )


def assert_same(found: Tracks, tracks: Tracks, pixels: float = 1e-3) -> None:
    """The same cameras, poses, keypoints, descriptors and landmarks, whatever their names."""
    found.check()
    for name in ("offsets", "descriptors", "landmark_of_keypoint", "landmark_ids", "octaves"):
        np.testing.assert_array_equal(getattr(found, name), getattr(tracks, name), name)
    np.testing.assert_allclose(found.keypoints, tracks.keypoints, atol=pixels)
    np.testing.assert_allclose(found.sizes, tracks.sizes, rtol=1e-5)
    np.testing.assert_allclose(found.angles, tracks.angles, atol=1e-3)
    np.testing.assert_allclose(found.cam_from_world, tracks.cam_from_world, atol=1e-6)
    np.testing.assert_allclose(found.landmark_positions, tracks.landmark_positions, atol=1e-6)
    for a, b in zip(found.keyframe_camera, tracks.keyframe_camera, strict=True):
        camera, expected = found.cameras[int(a)], tracks.cameras[int(b)]
        assert camera.model == expected.model
        assert (camera.width, camera.height) == (expected.width, expected.height)
        np.testing.assert_allclose(camera.params, expected.params, rtol=1e-6, atol=1e-9)


_JUNK: list[Any] = [
    *(None, -1, 0, 1, 2, 3, 7, 2**31, 2**62, 0.5, 1e300, float("inf"), "text", "20", "", b""),
    *(b"\0" * 320, b"\xff" * 48, b"text"),
]


def change_cell(path: Path, rng: np.random.Generator) -> None:
    """Put any value into any column of an SQLite database, or remove the column or table."""

    def choice(values: list[Any]) -> Any:
        return values[int(rng.integers(0, len(values)))]

    connection = sqlite3.connect(path)
    connection.execute("PRAGMA synchronous = OFF")
    table = choice(
        connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
    )[0]
    column = choice(connection.execute(f"PRAGMA table_info({table})").fetchall())[1]
    rows = [row for (row,) in connection.execute(f"SELECT rowid FROM {table}")]
    with suppress(sqlite3.IntegrityError, sqlite3.OperationalError):
        if rng.integers(0, 20) == 0:
            connection.execute(
                choice([f"ALTER TABLE {table} DROP {column}", f"DROP TABLE {table}"])
            )
        elif rows:
            values = (choice(_JUNK), choice(rows))
            connection.execute(f"UPDATE {table} SET {column} = ? WHERE rowid = ?", values)
    connection.commit()
    connection.close()


def check_broken_files(
    source: Path,
    read: Callable[[Path], Tracks],
    folder: Path,
    files: int = 300,
) -> None:
    """Broken copies of a map, a file or a folder, are read as tracks that fit or refused."""
    print(f"PROTOMARK_SEED={SEED}")
    rng = np.random.default_rng(SEED)
    copy = folder / "broken" / source.name
    copy.parent.mkdir()
    (shutil.copytree if source.is_dir() else shutil.copyfile)(source, copy)
    parts = [p for p in sorted(copy.rglob("*")) if p.is_file()] if copy.is_dir() else [copy]
    texts: list[str] = []
    read(copy)
    with bounded(megabytes=512):
        for _ in range(files):
            part = parts[int(rng.integers(0, len(parts)))]
            whole = part.read_bytes()
            if whole.startswith(b"SQLite") and rng.integers(0, 2):
                change_cell(part, rng)
            else:
                part.write_bytes(mutated(whole, rng))
            try:
                read(copy).check()
            except (ValueError, FileNotFoundError) as error:
                texts.append(str(error))
            part.write_bytes(whole)
    print(f"{len(texts)} of {files} refused")
    assert [text for text in texts if str(copy) not in text or "\n" in text] == []
    assert files / 20 < len(texts) <= files
