"""Atlases of ORB-SLAM3: files of the program itself, changed ones, and broken ones."""

from __future__ import annotations

import csv
import json
import lzma
import struct
from pathlib import Path

import numpy as np
import pytest

import protomark as pm
from conftest import protomark
from foreign_scene import check_broken_files, counts, foreign, reprojection_errors
from protomark.geometry.camera import Camera
from protomark.geometry.pose import camera_centers
from protomark.maps.build import build_map
from protomark.maps.places import map_places
from protomark.tracks.file import Tracks
from protomark.tracks.importers import orbslam3, read_source
from protomark.tracks.importers.orbslam3 import _tracks, read, recognizes
from protomark.tracks.importers.orbslam3_atlas import AtlasReader

DATA = Path(__file__).parent / "data" / "orbslam3"
SPEED = 0.5
WIDTH, HEIGHT = 480, 360


def unpacked(name: str, folder: Path) -> Path:
    path = folder / name
    path.write_bytes(lzma.decompress((DATA / f"{name}.xz").read_bytes()))
    return path


@pytest.fixture(scope="module")
def two_maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two maps, each of another photo, by a camera with distortion."""
    return unpacked("two_maps.osa", tmp_path_factory.mktemp("osa"))


@pytest.fixture(scope="module")
def stereo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of a pair of fisheye cameras."""
    return unpacked("stereo_fisheye.osa", tmp_path_factory.mktemp("osa"))


def true_centers(names: list[str]) -> np.ndarray:
    """Where the virtual camera was at the times that images are named by."""
    t = SPEED * np.array([float(name.split(" ")[0]) for name in names])
    x, y = 6.4 + 2.2 * np.sin(0.5 * t), 4.8 + 1.4 * np.sin(0.8 * t + 0.3)
    return np.column_stack([x, y, 3.2 + 0.5 * np.sin(0.6 * t)])


def similarity(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation and translation that move points onto others best (Umeyama 1991)."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1, 1, np.linalg.det(u @ vt)])
    rotation = u @ np.diag(sign) @ vt
    scale = (s * sign).sum() / (a**2).sum()
    return scale, rotation, target.mean(0) - scale * rotation @ source.mean(0)


def moved(centers: np.ndarray, by: tuple[float, np.ndarray, np.ndarray]) -> np.ndarray:
    scale, rotation, translation = by
    return scale * centers @ rotation.T + translation


def of_map(tracks: Tracks, number: int) -> np.ndarray:
    """Keyframes that observe landmarks of one of the atlas's maps."""
    first, last = tracks.info["source"]["maps"][number]["ids"]
    label = tracks.landmark_of_keypoint
    return np.unique(tracks.keyframe_of_keypoint[(label >= first) & (label <= last)])


@pytest.mark.parametrize(
    ("name", "found", "named"),
    [
        ("fly_mono_53kf.osa", (53, 1473, 9830, 23224), 9860),
        ("fly_mono_small.osa", (38, 990, None, 13287), 5823),
        ("fly_rgbd.osa", (28, 2307, 9153, 18339), 9215),
        ("fly_rgbd_boost182.osa", (14, 1378, None, 9778), 5200),
        ("derived/fly_rgbd_agg.osa", (28, 2307, 9153, 18339), 9215),
    ],
)
def test_counts_of_real_files(
    name: str, found: tuple[int, int, int | None, int], named: int
) -> None:
    tracks = read_source(foreign(f"orbslam3/{name}"))
    assert all(b in (a, None) for a, b in zip(counts(tracks), found, strict=True))
    # Landmarks name a few keypoints together, of which one landmark can have each.
    left_out = sum(tracks.info["source"].get("dropped", {}).values())
    assert len(tracks.observations) + left_out == named
    assert left_out < 0.01 * named
    errors = np.linalg.norm(reprojection_errors(tracks), axis=1)
    assert np.median(errors) < 1
    assert np.percentile(errors, 99) < 6
    assert tracks.info["detector"] == {"name": "ORB-SLAM", "levels": 8, "scale_factor": 1.2}


def test_two_maps_of_a_distorted_camera(two_maps: Path) -> None:
    assert recognizes(two_maps, two_maps.read_bytes()[:4096])
    tracks = read(two_maps)
    assert counts(tracks) == (39, 1083, 6949, 21919)
    (camera,) = tracks.cameras.values()
    assert (camera.model, camera.width, camera.height) == ("OPENCV", WIDTH, HEIGHT)
    np.testing.assert_allclose(camera.params, (400, 400, 240, 180, -0.28, 0.07, 0.001, -0.0007))
    errors = np.linalg.norm(reprojection_errors(tracks), axis=1)
    assert (np.median(errors), np.percentile(errors, 99)) < (1, 5)
    first, second = tracks.info["source"]["maps"]
    assert [first["ids"], second["ids"]] == [[4, 1516], [1517, 3867]]
    assert first["landmarks"] + second["landmarks"] == 1083
    # Two views of a plane have two interpretations, and ORB-SLAM3 took the wrong one in map 0.
    rows = of_map(tracks, 1)
    truth = true_centers([tracks.keyframe_names[i] for i in rows])
    centers = camera_centers(tracks.cam_from_world[rows])
    off = np.linalg.norm(moved(centers, similarity(centers, truth)) - truth, axis=1)
    assert off.max() < 0.03


def test_two_fisheye_cameras(stereo: Path) -> None:
    tracks = read(stereo)
    assert counts(tracks) == (8, 434, 1228, 4009)
    left, right = tracks.cameras.values()
    assert left.model == right.model == "OPENCV_FISHEYE"
    assert (left.params[:4], right.params[:4]) == ((190, 190, 240, 180), (195, 195, 236, 180))
    errors = np.linalg.norm(reprojection_errors(tracks), axis=1)
    is_right = np.array([name.endswith(" right") for name in tracks.keyframe_names])
    of_right = is_right[tracks.keyframe_of_keypoint[tracks.observations]]
    assert is_right.sum() == 4
    assert of_right.sum() > 400
    for side in (of_right, ~of_right):
        assert np.median(errors[side]) < 0.7
    centers = camera_centers(tracks.cam_from_world)
    apart = np.linalg.norm(centers[is_right] - centers[~is_right], axis=1)
    np.testing.assert_allclose(apart, 0.3, atol=1e-5)


class _Recorder(AtlasReader):
    """Remembers where objects and lists begin."""

    def __init__(self, data: bytes, path: Path) -> None:
        super().__init__(data, path)
        self.seen: list[tuple[str, int]] = []

    def object(self, name: str, known: dict[str, int]) -> None:
        super().object(name, known)
        self.seen.append((name, self.offset))

    def items(self, name: str, size: int) -> range:
        out = super().items(name, size)
        self.seen.append((name, self.offset))
        return out


def offsets(path: Path, name: str) -> list[int]:
    recorder = _Recorder(path.read_bytes(), path)
    recorder.atlas()
    return [offset for kind, offset in recorder.seen if kind == name]


@pytest.mark.parametrize("version", [16, 17, 18, 19])
def test_archive_versions(version: int, stereo: Path, tmp_path: Path) -> None:
    data = bytearray(stereo.read_bytes())
    data[30:32] = struct.pack("<H", version)
    (tmp_path / "x.osa").write_bytes(data)
    tracks = read(tmp_path / "x.osa")
    assert np.array_equal(tracks.descriptors, read(stereo).descriptors)
    assert tracks.info["source"]["archive"] == f"Boost {version}"


def test_inertial_measurements_are_passed_over(stereo: Path, tmp_path: Path) -> None:
    """As an inertial map has them: on the first of a type its header precedes it."""
    data = stereo.read_bytes()
    first, second = offsets(stereo, "measurements")[:2]
    for at, count, header in ((second, 3, b""), (first, 2, bytes(5))):
        head = struct.pack("<QI", count, 0)
        data = data[: at - 12] + head + header + bytes(28 * count) + data[at:]
    (tmp_path / "x.osa").write_bytes(data)
    assert counts(read(tmp_path / "x.osa")) == counts(read(stereo))


@pytest.mark.parametrize(
    ("kind", "number", "place"),
    [
        ("KeyFrame", 2, r"keyframe 3 of 4 of map 0"),
        ("MapPoint", 7, r"point (8|9) of 434 of map 0"),
        ("Map", 0, r"keyframe 1 of|maps"),
    ],
)
def test_fields_of_a_fork(kind: str, number: int, place: str, stereo: Path, tmp_path: Path) -> None:
    at = offsets(stereo, kind)[number]
    data = stereo.read_bytes()
    (tmp_path / "x.osa").write_bytes(data[: at + 8] + b"\1\2\3\4" + data[at + 8 :])
    with pytest.raises(ValueError, match=rf"x\.osa, ({place}).*, byte [\d,]+: .*fork of ORB-SLAM3"):
        read(tmp_path / "x.osa")


def test_files_that_do_not_end_with_the_atlas(stereo: Path, tmp_path: Path) -> None:
    data = stereo.read_bytes()
    for changed, message in (
        (data + b"more", r"end, byte [\d,]+: 4 bytes too many"),
        (data[:-1], r"cameras, byte [\d,]+: 48 bytes should follow, but 47 do"),
        (data[: len(data) // 2], r"keyframe \d+ of 4 of map 0, byte"),
        (data[:40], r"header, byte"),
        (b"22 serialization::archive 16 0 0", "is a text archive: save it as a binary one"),
        (data[:32] + b"\4\4\4\4" + data[36:], "was written on a machine with other sizes"),
    ):
        (tmp_path / "x.osa").write_bytes(changed)
        with pytest.raises(ValueError, match=message):
            read_source(tmp_path / "x.osa")
    with pytest.raises(ValueError, match=r"empty_atlas\.osa: the atlas is empty"):
        read_source(DATA / "empty_atlas.osa")


def test_bad_and_contradicting_points(two_maps: Path) -> None:
    """Bad ones are left out; a keypoint that two landmarks name is that of the one it names."""
    atlas = AtlasReader(two_maps.read_bytes(), two_maps).atlas()
    whole = _tracks(atlas)
    first, second = sorted(atlas.maps, key=lambda one: one.id)
    bad = first.points[0]
    first.points[0] = bad._replace(bad=True)
    first.points[1] = first.points[1]._replace(position=(np.nan, 0.0, 0.0))
    gone = second.keyframes[0]
    gone.bad = True
    tracks = _tracks(atlas)
    dropped = tracks.info["source"]["dropped"]
    assert (dropped["bad landmarks"], dropped["bad keyframes"]) == (2, 1)
    assert dropped["observations of keyframes that are not in the file"] > 0
    assert len(tracks.keyframe_names) == len(whole.keyframe_names) - 1
    assert bad.id not in tracks.landmark_ids
    tracks.check()


def test_rectified_images(two_maps: Path) -> None:
    """Keypoints are not distorted, whatever the coefficients say."""
    atlas = AtlasReader(two_maps.read_bytes(), two_maps).atlas()
    for one in atlas.maps:
        for keyframe in one.keyframes:
            keyframe.keypoints = keyframe.undistorted
            keyframe.lens = keyframe.lens._replace(bounds=(0, 0, WIDTH, HEIGHT))
    tracks = _tracks(atlas)
    assert list(tracks.cameras.values()) == [Camera("PINHOLE", WIDTH, HEIGHT, (400, 400, 240, 180))]
    assert "rectify query images alike" in tracks.info["source"]["note"]
    assert np.median(np.linalg.norm(reprojection_errors(tracks), axis=1)) < 1


def test_ids_of_maps_that_interleave(two_maps: Path) -> None:
    atlas = AtlasReader(two_maps.read_bytes(), two_maps).atlas()
    whole = _tracks(atlas)
    _, second = sorted(atlas.maps, key=lambda one: one.id)
    second.points[:] = [p._replace(id=p.id - 1500) for p in second.points]
    for keyframe in second.keyframes:
        keyframe.points = np.where(keyframe.points >= 0, keyframe.points - 1500, -1)
    tracks = _tracks(atlas)
    assert np.array_equal(tracks.landmark_ids, whole.landmark_ids)
    assert np.array_equal(tracks.landmark_of_keypoint, whole.landmark_of_keypoint)


def test_broken_files(stereo: Path, tmp_path: Path) -> None:
    check_broken_files(stereo, orbslam3.read, tmp_path)


def test_build_and_localize(two_maps: Path, tmp_path: Path) -> None:
    """Views that ORB-SLAM3 never saw are found, in the map that their photo is in."""
    scene = tmp_path / "scene.pmk"
    done = protomark("build", two_maps, "-o", scene, "--json", tmp_path / "facts.json")
    assert done.returncode == 0, done.stderr
    assert "2 maps, each in coordinates of its own" in " ".join(done.stdout.split())
    facts = json.loads((tmp_path / "facts.json").read_text())
    assert facts["sources"][0]["observations"] == 6949
    sealed = pm.open(tmp_path / "scene.sealed.pmk")
    assert json.loads(sealed.metadata["detector"])["levels"] == 8
    tracks = read(two_maps)
    done = protomark("localize", tmp_path / "scene.sealed.pmk", DATA, "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader((tmp_path / "out" / "poses.csv").open()))
    assert len(rows) == 4
    for row in rows:
        number = int(float(row["image"].removesuffix(".jpg")) > 7)
        assert row["place"] == f"two_maps.osa, map {number}"
        if number == 0:  # see above
            continue
        keyframes = of_map(tracks, number)
        truth = true_centers([tracks.keyframe_names[i] for i in keyframes])
        by = similarity(camera_centers(tracks.cam_from_world[keyframes]), truth)
        center = np.array([[float(row[f"center_{axis}"]) for axis in "xyz"]])
        expected = true_centers([row["image"].removesuffix(".jpg")])
        assert np.linalg.norm(moved(center, by) - expected) < 0.05


def test_tracks_of_an_atlas(two_maps: Path, tmp_path: Path) -> None:
    done = protomark("tracks", two_maps, "-o", tmp_path)
    assert done.returncode == 0, done.stderr
    saved, tracks = Tracks.load(tmp_path / "two_maps.orb.safetensors"), read(two_maps)
    assert np.array_equal(saved.descriptors, tracks.descriptors)
    assert saved.info["source"] == tracks.info["source"]
    done = protomark("seal", tmp_path / "two_maps.orb.safetensors", "-o", tmp_path / "x.pmk")
    assert done.returncode == 0, done.stderr
    assert [place.name[-5:] for place in map_places(pm.open(tmp_path / "x.pmk").metadata)] == [
        "map 0",
        "map 1",
    ]


def test_held_out_keyframes_are_found_as_by_hamming_distance(two_maps: Path) -> None:
    tracks = read(two_maps)
    queries = np.arange(len(tracks.keyframe_names)) % 5 == 2
    asked = queries[tracks.keyframe_of_keypoint]
    kept = tracks.where(~asked)
    scene = build_map(kept, pm.Encoder.load("orb"))
    rows = np.flatnonzero(asked & np.isin(tracks.landmark_of_keypoint, scene.ids))
    truth = tracks.landmark_of_keypoint[rows]
    ids, _ = scene.search(tracks.descriptors[rows], k=1)
    seen = kept.observations[np.isin(kept.landmark_of_keypoint[kept.observations], scene.ids)]
    nearest, _ = pm.hamming_search(tracks.descriptors[rows], kept.descriptors[seen], k=1)
    raw = kept.landmark_of_keypoint[seen[nearest[:, 0]]]
    assert len(rows) > 500
    assert (ids[:, 0] == truth).mean() > 0.97 * (raw == truth).mean() > 0.7
