"""Scenes that are written for other programs, and what these read there."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import protomark as pm
from conftest import protomark, random_descriptors
from protomark import sample
from protomark.exporters import export
from protomark.exporters.stella import _packed
from protomark.features.descriptors import unpack_bits
from protomark.geometry.camera import Camera
from protomark.geometry.colmap import pycolmap, read_model
from protomark.tracks.file import Tracks
from protomark.tracks.importers import read_source
from small_tracks import small_tracks

LENS = Camera("OPENCV", 640, 480, (500.0, 505.0, 320.0, 240.0, -0.1, 0.02, 0.001, 0.002))


@pytest.fixture
def tracks(tmp_path: Path) -> Tracks:
    """Tracks of two keyframes of different cameras, with a doubled observation."""
    tracks = small_tracks()
    tracks.cameras[2] = LENS
    tracks.keyframe_camera[1] = 2
    rng = np.random.default_rng(1)
    rotation = cv2.Rodrigues(rng.normal(size=3))[0]
    tracks.cam_from_world[1] = np.column_stack([rotation, rng.normal(size=3)])
    tracks.landmark_of_keypoint[20:23] = [4, 4, -1]
    tracks.save(tmp_path / "tracks.safetensors")
    return tracks


def observed(tracks: Tracks) -> set[tuple[int, int]]:
    rows = tracks.observations
    keyframes = tracks.keyframe_of_keypoint[rows]
    return set(zip(keyframes.tolist(), tracks.landmark_of_keypoint[rows].tolist(), strict=True))


def read_ply(path: Path) -> np.ndarray:
    header, _, data = path.read_bytes().partition(b"end_header\n")
    kinds = {"double": "<f8", "uint": "<u4", "uchar": "u1"}
    words = [line.split() for line in header.decode().splitlines()]
    dtype = [(w[2], kinds[w[1]]) for w in words if w[0] == "property"]
    rows = np.frombuffer(data, dtype)
    assert ["element", "vertex", str(len(rows))] in words
    return rows


def test_ply_has_positions_and_counts(encoder: pm.Encoder, tmp_path: Path) -> None:
    scene = pm.PrototypeMap(encoder)
    scene.add([3, 3, 5, 9], random_descriptors(4))
    positions = np.array([[1.5, 2, 3], [1e6 + 0.25, 5, 6]])
    scene.set_positions([3, 9], positions)
    scene.save(tmp_path / "scene.pmk")
    scene.seal(tmp_path / "sealed.pmk")
    for name in ("scene.pmk", "sealed.pmk"):
        done = protomark("export", tmp_path / name, "--to", "ply", "-o", tmp_path / "out.ply")
        assert done.returncode == 0, done.stderr
        rows = read_ply(tmp_path / "out.ply")
        np.testing.assert_allclose(np.column_stack([rows[a] for a in "xyz"]), positions, atol=0.05)
        if name == "scene.pmk":
            assert rows["count"].tolist() == [2, 1]
    pm.PrototypeMap(encoder).save(tmp_path / "empty.pmk")
    with pytest.raises(ValueError, match="no landmark has a position"):
        export(tmp_path / "empty.pmk", tmp_path / "none.ply", "ply")
    assert not (tmp_path / "none.ply").exists()


def test_colmap_reads_tracks(tracks: Tracks, tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for name in tracks.keyframe_names:
        cv2.imwrite(str(images / name), np.full((480, 640, 3), (10, 20, 30), np.uint8))
    export(tmp_path / "tracks.safetensors", tmp_path / "model", "colmap", images)
    model = read_model(tmp_path / "model" / "sparse" / "0")
    assert (model.names, model.cameras) == (tracks.keyframe_names, tracks.cameras)
    np.testing.assert_allclose(model.cam_from_world, tracks.cam_from_world, atol=1e-12)
    found = pycolmap.Reconstruction(str(tmp_path / "model" / "sparse" / "0"))
    pairs = set()
    for i, point in found.points3D.items():
        np.testing.assert_array_equal(point.xyz, tracks.positions_of(np.array([i]))[0])
        np.testing.assert_allclose(point.color, [30, 20, 10], atol=2)
        for element in point.track.elements:
            pairs.add((element.image_id - 1, i))
            row = tracks.offsets[element.image_id - 1] + element.point2D_idx
            assert tracks.landmark_of_keypoint[row] == i
            xy = found.images[element.image_id].points2D[element.point2D_idx].xy
            np.testing.assert_array_equal(xy, tracks.keypoints[row])
    assert pairs == observed(tracks)
    export(tmp_path / "tracks.safetensors", tmp_path / "points.ply", "ply", images)
    assert read_ply(tmp_path / "points.ply")["red"].tolist() == [30] * len(found.points3D)


def test_nerfstudio_sees_what_the_cameras_saw(tracks: Tracks, tmp_path: Path) -> None:
    export(tmp_path / "tracks.safetensors", tmp_path / "splats", "nerfstudio")
    facts = json.loads((tmp_path / "splats" / "transforms.json").read_text())
    points = np.random.default_rng(2).uniform(3, 4, (5, 3))
    for i, frame in enumerate(facts["frames"]):
        assert frame["file_path"] == f"images/{tracks.keyframe_names[i]}"
        matrix = np.array(frame["transform_matrix"])
        # x right, y up, z backward in the camera.
        local = (np.column_stack([points, np.ones(5)]) @ np.linalg.inv(matrix).T)[:, :3]
        pose = tracks.cam_from_world[i]
        np.testing.assert_allclose(local * [1, -1, -1], points @ pose[:, :3].T + pose[:, 3])
    second = facts["frames"][1]
    names = ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
    assert [second[n] for n in names] == [640, 480, *LENS.params]
    cloud = read_ply(tmp_path / "splats" / facts["ply_file_path"])
    assert len(cloud) == len({landmark for _, landmark in observed(tracks)})
    # One camera stands once.
    sample_facts = tmp_path / "sample"
    export(Path(sample.path()), sample_facts, "nerfstudio")
    facts = json.loads((sample_facts / "transforms.json").read_text())
    assert facts["camera_model"] == "OPENCV"
    assert "fl_x" not in facts["frames"][0]
    assert facts["w"] == 1280


def unpack(data: memoryview, at: int = 0) -> tuple[Any, int]:
    """A value of MessagePack, and where the next one begins."""
    kind, at = data[at], at + 1
    if kind < 0x80:
        return kind, at
    if kind in (0xCA, 0xCB):
        size = 4 if kind == 0xCA else 8
        return struct.unpack_from(">f" if size == 4 else ">d", data, at)[0], at + size
    if 0xCC <= kind <= 0xCF:
        size = 1 << (kind - 0xCC)
        return int.from_bytes(data[at : at + size], "big"), at + size
    for short, mask, long in ((0xA0, 31, 0xDA), (0x80, 15, 0xDE), (0x90, 15, 0xDC)):
        if kind & ~mask & 0xFF == short:
            count = kind & mask
        elif kind in (long, long + 1):
            size = 2 if kind == long else 4
            count, at = int.from_bytes(data[at : at + size], "big"), at + size
        else:
            continue
        if short == 0xA0:
            return bytes(data[at : at + count]).decode(), at + count
        values = []
        for _ in range(count * (2 if short == 0x80 else 1)):
            value, at = unpack(data, at)
            values.append(value)
        return (dict(zip(values[::2], values[1::2], strict=True)) if short == 0x80 else values), at
    raise AssertionError(hex(kind))


def test_messagepack_is_that_of_its_specification() -> None:
    numbers = [0, 127, 128, 255, 256, 65535, 65536, 2**32 - 1, 2**32, 2**63, 0.5, 0.1, -1e300]
    value = {"a": numbers, "b" * 40: ["x" * 70000, [], {}], "c": list(range(70000))}
    assert unpack(memoryview(_packed(value)))[0] == value
    assert [_packed(v)[0] for v in numbers[:4]] == [0, 127, 0xCC, 0xCC]
    assert _packed(0.5)[0] == 0xCA


def test_stella_gets_one_descriptor_a_landmark(tracks: Tracks, tmp_path: Path) -> None:
    output = tmp_path / "map.msg"
    facts = export(tmp_path / "tracks.safetensors", output, "stella")
    data = output.read_bytes()
    found, end = unpack(memoryview(data))
    assert end == len(data) == facts["bytes"]
    pairs = set()
    votes: dict[int, set[bytes]] = {}
    for i, frame in found["keyframes"].items():
        lists = [frame[name] for name in ("undist_keypts", "descs", "lm_ids")]
        assert {len(one) for one in lists} == {frame["n_keypts"]}
        assert len(set(frame["lm_ids"])) == frame["n_keypts"] >= 1
        assert frame["cam"] in found["cameras"]
        assert frame["orb_params"] in found["orb_params"]
        pairs |= {(int(i), landmark) for landmark in frame["lm_ids"]}
        for landmark, words in zip(frame["lm_ids"], frame["descs"], strict=True):
            votes.setdefault(landmark, set()).add(np.array(words, "<u4").tobytes())
        pose = tracks.cam_from_world[int(i)]
        assert frame["trans_cw"] == pose[:, 3].tolist()
    assert pairs == observed(tracks)
    assert [found["keyframes"][i]["span_parent"] for i in "01"] == [2**32 - 1, 0]
    assert found["keyframes"]["0"]["span_children"] == [1]
    for landmark, record in found["landmarks"].items():
        assert record["pos_w"] == tracks.positions_of(np.array([int(landmark)]))[0].tolist()
        assert (record["ref_keyfrm"], int(landmark)) in pairs
        (vote,) = votes[int(landmark)]
        seen = np.flatnonzero(tracks.landmark_of_keypoint == int(landmark))
        seen = seen[np.unique(tracks.keyframe_of_keypoint[seen], return_index=True)[1]]
        bits = unpack_bits(tracks.descriptors[seen])
        assert (
            unpack_bits(np.frombuffer(vote, np.uint8)[None])[0] == (2 * bits.sum(0) >= len(bits))
        ).all()
    # Keypoints are those of a lens without distortion, and begin at (0, 0).
    frame = found["keyframes"]["1"]
    row = 20 + int(np.argmax(tracks.landmark_of_keypoint[20:] == frame["lm_ids"][-1]))
    at = frame["undist_keypts"][-1]["pt"]
    expected = LENS.rays(tracks.keypoints[row : row + 1].astype(float))[0] * LENS.params[:2]
    np.testing.assert_allclose(at, expected + np.array(LENS.params[2:4]) - 0.5)


def test_the_importer_reads_it_back(tracks: Tracks, tmp_path: Path) -> None:
    importers = pytest.importorskip("protomark.tracks.importers")
    export(tmp_path / "tracks.safetensors", tmp_path / "map.msg", "stella")
    back = importers.read_source(tmp_path / "map.msg")
    assert observed(back) == observed(tracks)
    np.testing.assert_allclose(back.cam_from_world, tracks.cam_from_world, atol=1e-12)
    assert next(iter(back.cameras.values())).params == tracks.cameras[1].params
    landmark = back.landmark_of_keypoint[-1]
    row = 20 + int(np.argmax(tracks.landmark_of_keypoint[20:] == landmark))
    np.testing.assert_allclose(back.keypoints[-1], tracks.keypoints[row], atol=1e-3)


def test_what_cannot_be_exported(tracks: Tracks, encoder: pm.Encoder, tmp_path: Path) -> None:
    source, scene = tmp_path / "tracks.safetensors", tmp_path / "scene.pmk"
    pm.PrototypeMap(encoder).save(scene)
    freak, fisheye = tmp_path / "freak.safetensors", tmp_path / "fisheye.safetensors"
    replace(tracks, descriptor="freak").save(freak)
    camera = Camera("FOV", 640, 480, (500.0, 500.0, 320.0, 240.0, 0.5))
    replace(tracks, cameras={**tracks.cameras, 2: camera}).save(fisheye)
    mixed, lens = tmp_path / "mixed.safetensors", (500.0, 500.0, 320.0, 240.0, 0.1, 0, 0, 0)
    camera = Camera("OPENCV_FISHEYE", 640, 480, lens)
    replace(tracks, cameras={**tracks.cameras, 2: camera}).save(mixed)
    taken, output = tmp_path / "taken", tmp_path / "out"
    taken.mkdir()
    (taken / "file").write_text("mine")
    for path, to, images, message in (
        (scene, "colmap", None, "holds landmarks only"),
        (scene, "stella", None, "holds no descriptors"),
        (freak, "stella", None, "reads ORB only"),
        (fisheye, "stella", None, "has no camera FOV"),
        (fisheye, "nerfstudio", None, "has no camera FOV"),
        (mixed, "nerfstudio", None, "fisheyes or none, and this scene has both"),
        (source, "colmap", tmp_path, "a.png: no such image"),
        (source, "stella", tmp_path, "no colours"),
        (tmp_path, "colmap", None, "no COLMAP model"),
    ):
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            export(path, output, to, images)  # type: ignore[arg-type]
        assert not output.exists()
    with pytest.raises(FileExistsError, match="holds files"):
        export(source, taken, "colmap")
    with pytest.raises(ValueError, match="is an input"):
        export(source, source, "ply")
    assert (taken / "file").read_text() == "mine"


def test_kapture_is_read_back(tmp_path: Path) -> None:
    done = protomark("export", sample.path(), "--to", "kapture", "-o", tmp_path / "kapture")
    assert done.returncode == 0, done.stderr
    read, toy = read_source(tmp_path / "kapture"), sample.load()
    assert read.keyframe_names == toy.keyframe_names
    np.testing.assert_array_equal(read.descriptors, toy.descriptors)
    with pytest.raises(ValueError, match="holds no descriptors, which kapture needs: give tracks"):
        export(tmp_path, tmp_path / "new", "kapture")
