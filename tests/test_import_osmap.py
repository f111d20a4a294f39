"""Maps of osmap: written files, files of the program itself, and broken ones."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

import protomark as pm
from conftest import protomark
from foreign_scene import assert_same, check_broken_files, counts, foreign, orb_tracks
from protomark.geometry.camera import Camera
from protomark.tracks.file import Tracks
from protomark.tracks.importers import read_source
from protomark.tracks.importers.binary import Reader
from protomark.tracks.importers.osmap import _size, read
from protomark.tracks.importers.protobuf import fields, varint

CAMERA = Camera("PINHOLE", 1280, 964, (923.8, 920.1, 640.5, 482.5))


def number(value: int) -> bytes:
    out = b""
    while value > 127:
        out += bytes([value & 127 | 128])
        value >>= 7
    return out + bytes([value])


def tagged(field: int, value: int | float | bytes) -> bytes:
    """A field: a number, a float32, or a message; zeros are left out, as proto3 does."""
    if isinstance(value, float):
        return number(field << 3 | 5) + struct.pack("<f", value) if value else b""
    if isinstance(value, int):
        return number(field << 3) + number(value) if value else b""
    return number(field << 3 | 2) + number(len(value)) + value


def write(folder: Path, tracks: Tracks, features: bool = True, delimited: bool = True) -> Path:
    """Write tracks as osmap does; ids of landmarks must be above 0."""
    camera = tracks.cameras[1]
    fx, fy, cx, cy = camera.params
    (folder / "map.yaml").write_text(
        '%YAML:1.0\n---\nmappointsFile: "map.mappoints"\nkeyframesFile: "/home/me/map.keyframes"\n'
        f'featuresFile: "map.features"\nOptions: {0 if delimited else 2}\n'
        f"Options descriptions: [ {'' if delimited else 'FEATURES_FILE_NOT_DELIMITED'} ]\n"
        f"cameraMatrices:\n   - {{ fx:{fx}, fy:{fy}, cx:{cx - 0.5}, cy:{cy - 0.5} }}\n"
    )
    keyframes = b""
    for i, pose in enumerate(tracks.cam_from_world):
        packed = tagged(1, pose.astype("<f4").tobytes())
        time = number(6 << 3 | 1) + struct.pack("<d", i / 10)
        keyframes += tagged(1, tagged(1, i) + tagged(2, packed) + time)
    (folder / "map.keyframes").write_bytes(keyframes)
    points = b""
    for landmark, xyz in zip(tracks.landmark_ids, tracks.landmark_positions, strict=True):
        row = np.flatnonzero(tracks.landmark_of_keypoint == landmark)[0]
        position = b"".join(tagged(k, float(v)) for k, v in enumerate(xyz, 1))
        descriptor = tagged(1, tracks.descriptors[row].tobytes())
        counted = tagged(3, 2.0) + tagged(4, 1.0)
        points += tagged(
            1, tagged(1, int(landmark)) + tagged(2, position) + counted + tagged(5, descriptor)
        )
    (folder / "map.mappoints").write_bytes(points)
    if not features:
        return folder / "map.yaml"
    messages = []
    for i in range(len(tracks.keyframe_names)):
        message = tagged(1, i)
        for row in range(*tracks.offsets[i : i + 2].tolist()):
            x, y = (float(v) - 0.5 for v in tracks.keypoints[row])
            at = tagged(1, x) + tagged(2, y) + tagged(3, int(tracks.octaves[row]))
            keypoint = at + tagged(4, float(tracks.angles[row]))
            label = max(0, int(tracks.landmark_of_keypoint[row]))
            descriptor = tagged(1, tracks.descriptors[row].tobytes())
            message += tagged(2, tagged(1, keypoint) + tagged(2, label) + tagged(3, descriptor))
        messages.append(message)
    if delimited:
        data = b"".join(number(len(m)) + m for m in messages)
    else:
        data = b"".join(tagged(1, m) for m in messages)
    (folder / "map.features").write_bytes(data)
    return folder / "map.yaml"


@pytest.fixture(scope="module")
def tracks() -> Tracks:
    found = orb_tracks(CAMERA, count=2)
    found.landmark_ids = found.landmark_ids + 1
    label = found.landmark_of_keypoint
    found.landmark_of_keypoint = np.where(label >= 0, label + 1, -1)
    # What a file lacks, or has as float32.
    found.landmark_positions = found.landmark_positions.astype(np.float32).astype(np.float64)
    found.cam_from_world = found.cam_from_world.astype(np.float32).astype(np.float64)
    found.octaves = np.maximum(found.octaves, 0)
    found.sizes = (31 * 1.2**found.octaves).astype(np.float32)
    return found


@pytest.mark.parametrize("delimited", [True, False])
def test_what_was_written_is_read(delimited: bool, tracks: Tracks, tmp_path: Path) -> None:
    write(tmp_path, tracks, delimited=delimited)
    for path in (tmp_path, tmp_path / "map.yaml"):
        found = read_source(path)
        assert found.info["source"]["program"] == "ORB-SLAM2 (osmap)"
        assert found.info["detector"] == {"name": "ORB-SLAM"}
        assert (found.cameras[1].width, found.cameras[1].height) == (1280, 960)
        found.cameras = {1: Camera("PINHOLE", 1280, 964, found.cameras[1].params)}
        assert_same(found, tracks)


def test_one_descriptor_per_landmark(tracks: Tracks, tmp_path: Path) -> None:
    write(tmp_path, tracks, features=False)
    found = read(tmp_path)
    assert counts(found) == (2, *[len(tracks.landmark_ids)] * 3)
    assert "no .features" in found.info["source"]["note"]
    assert np.array_equal(np.sort(found.landmark_of_keypoint), tracks.landmark_ids)
    done = protomark("build", tmp_path, "-o", tmp_path / "scene.pmk")
    assert done.returncode == 0, done.stderr
    assert "has no keypoint of its own" in " ".join(done.stdout.split())
    scene = pm.open(tmp_path / "scene.pmk")
    assert np.array_equal(scene.ids, tracks.landmark_ids)


def test_sizes_of_images_are_guessed() -> None:
    for center, reach, size in (
        ((325.1, 249.7), (625, 460), (640, 480)),  # TUM's second Freiburg camera
        ((607.19, 185.2), (0, 0), (1215, 371)),
        ((325.1, 249.7), (700, 460), (701, 500)),
        ((100.0, 90.0), (0, 0), (200, 180)),
    ):
        assert _size(np.array(center), np.array(reach)) == size


def test_the_real_one() -> None:
    found = read_source(foreign("osmap"))
    assert counts(found) == (288, 12017, 12017, 12017)
    (camera,) = found.cameras.values()
    assert camera == Camera("PINHOLE", 640, 480, (600, 600, 320.5, 240.5))
    inside = ((found.keypoints > 0) & (found.keypoints < [640, 480])).all(1)
    assert inside.mean() > 0.99


def test_what_does_not_fit(tracks: Tracks, tmp_path: Path) -> None:
    write(tmp_path, tracks)
    text = (tmp_path / "map.yaml").read_text()
    for changed, message in (
        (text.replace("fx:", "f:"), r"map\.yaml: 0 camera matrices"),
        (text.replace("cx:640.0", "cx:1e9"), "a principal point outside any image"),
        (text.replace("cx:640.0", "cx:1e9.0"), "a camera matrix holds something that is no number"),
        (text.replace("map.keyframes", "gone.keyframes"), "no such file, but map.yaml names it"),
    ):
        (tmp_path / "map.yaml").write_text(changed)
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            read(tmp_path)
    (tmp_path / "map.yaml").write_text(text)
    (tmp_path / "map.keyframes").write_bytes(b"")
    with pytest.raises(ValueError, match="the map is empty"):
        read(tmp_path)
    (tmp_path / "other.yaml").write_text(text)
    with pytest.raises(ValueError, match="holds 2 maps of osmap"):
        read(tmp_path)


def test_broken_files(tracks: Tracks, tmp_path: Path) -> None:
    folder = tmp_path / "whole"
    folder.mkdir()
    write(folder, tracks)
    check_broken_files(folder, read, tmp_path, files=200)


def test_protobuf_that_does_not_fit() -> None:
    def read_all(data: bytes) -> list[tuple[int, int, object]]:
        return list(fields(Reader(data, Path("x.pb"))))

    assert read_all(b"\x08\x96\x01\x15\0\0\0\0\x1a\x01z") == [
        (1, 0, 150),
        (2, 5, b"\0\0\0\0"),
        (3, 2, 1),
    ]
    assert varint(Reader(b"\xff" * 9 + b"\x01", Path("x"))) == 2**64 - 1
    for data, message in (
        (b"\xff" * 11, "a number does not end"),
        (b"\x08", "a number does not end"),
        (b"\x1a\x05abc", "5 bytes end after their message"),
        (b"\x15\0\0", "4 bytes should follow, but 2 do"),
        (b"\x0b", "a field has the unknown wire type 3"),
        (b"\x00\x01", "a field has the number 0"),
    ):
        with pytest.raises(ValueError, match=rf"x\.pb, byte \d+: {message}"):
            read_all(data)
