"""A folder of shards answers as one map does, bit for bit, while shards come and go."""

from __future__ import annotations

import json
import shutil
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import protomark as pm
from conftest import balanced_encoder, random_descriptors
from protomark import sample
from protomark.maps.build import build_map
from protomark.maps.neighbours import merged
from protomark.maps.shards import Manifest
from protomark.maps.split import split_file

QUERIES = random_descriptors(60, seed=3)


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of 300 landmarks, of which some are equal, so that there are ties."""
    scene = pm.PrototypeMap(balanced_encoder(), appearance_bits=3)
    rng = np.random.default_rng(1)
    descriptors = random_descriptors(100)[rng.integers(0, 100, 900)]
    scene.add(rng.permutation(np.arange(900) % 300) * 7, descriptors)
    positions = rng.normal(0, 10, (len(scene), 3))
    positions[::9] = np.nan
    scene.set_positions(scene.ids, positions)
    scene.metadata = {"frame": "metres"}
    path = tmp_path_factory.mktemp("one") / "one.pmk"
    scene.save(path)
    return path


@pytest.fixture(params=["ids", "space", "sealed", "file"])
def shards(request: Any, one: Path, tmp_path: Path) -> Path:
    if request.param == "file":
        return one
    how: dict[str, Any] = {"cell_size": 8.0} if request.param == "space" else {"parts": 5}
    split_file(one, tmp_path / "city", **how, sealed=request.param == "sealed")
    return tmp_path / "city"


def same(found: Any, expected: Any) -> None:
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == b.dtype
        assert np.array_equal(a, b)


def test_answers_are_those_of_one_map(shards: Path, one: Path) -> None:
    whole, city = pm.open(one), pm.ShardedMap(shards)
    assert (len(city), city.prototype_count) == (len(whole), whole.prototype_count)
    assert city.metadata == whole.metadata
    assert np.array_equal(city.ids, whole.ids)
    some = whole.ids[::3][::-1]
    assert np.allclose(city.positions(some), whole.positions(some), equal_nan=True, atol=1e-5)
    mask = np.arange(len(whole)) % 4 == 0
    for options in (
        {"k": 1},
        {"k": 2},
        {"k": 7, "threads": 2},
        {"k": 400},
        {"k": 1, "ratio": 0.9},
        {"k": 3, "ratio": 0.9, "max_distance": 9000},
        {"k": 3, "max_distance": 9000},
        {"among": some},
        {"among": mask},
        {"among": []},
    ):
        same(city.search(QUERIES, **options), whole.search(QUERIES, **options))
    found, extent = city.summary(), whole.summary()["extent"]
    assert found["landmarks_with_position"] == whole.summary()["landmarks_with_position"]
    assert np.array_equal(found["extent"], extent)
    for call in (city.positions, city.prototypes, lambda ids: city.search(QUERIES, among=ids)):
        with pytest.raises(KeyError):
            call(np.array([7, 8]))
    with pytest.raises(ValueError, match="no shard has an index"):
        city.search(QUERIES, recall=0.9)
    if shards.is_dir():
        city.verify()


def test_recall_counts_where_there_is_an_index(one: Path, tmp_path: Path) -> None:
    whole = pm.open(one)
    assert isinstance(whole, pm.PrototypeMap)
    split_file(one, tmp_path, parts=2)
    city = pm.ShardedMap(tmp_path)
    city.remove_shard("one.1")
    ids = whole.split_by_id([whole.ids[150]])[1]
    ids.build_index(4)
    ids.save(tmp_path / "indexed.pmk")
    assert city.add_shard(tmp_path / "indexed.pmk") == "indexed"
    assert city.nlist == 4
    assert 1 <= city.nprobe(0.9) <= 4
    same(city.search(QUERIES, recall=1.0), whole.search(QUERIES))


def test_only_what_is_touched_is_opened(one: Path, tmp_path: Path) -> None:
    split_file(one, tmp_path, parts=3)
    city = pm.ShardedMap(tmp_path)
    (tmp_path / "one.2.pmk").unlink()
    first = pm.open(tmp_path / "one.0.pmk")
    same(city.search(QUERIES, among=first.ids), first.search(QUERIES))
    assert len(city.positions(first.ids)) == len(first)
    with pytest.raises(FileNotFoundError, match=r"one.2.pmk is missing, which its manifest names"):
        city.search(QUERIES)


def test_shards_change_while_queries_run(one: Path, tmp_path: Path) -> None:
    whole = pm.open(one)
    split_file(one, tmp_path, parts=4)
    city, stop, problems = pm.ShardedMap(tmp_path), threading.Event(), []
    parts = [pm.open(tmp_path / f"one.{i}.pmk") for i in range(4)]
    without = merged([part.search(QUERIES) for part in (parts[0], parts[1], parts[3])], 2)

    def ask() -> None:
        while not stop.is_set():
            found = city.search(QUERIES)
            if not any(
                np.array_equal(found[0], right[0]) for right in (whole.search(QUERIES), without)
            ):
                problems.append(found)

    threads = [threading.Thread(target=ask) for _ in range(2)]
    for thread in threads:
        thread.start()
    for _ in range(20):
        city.remove_shard("one.2")
        city.add_shard(tmp_path / "one.2.pmk")
        city.refresh()
    stop.set()
    for thread in threads:
        thread.join()
    assert not problems
    with pytest.raises(ValueError, match=r"there is a shard one.2 already"):
        city.add_shard(tmp_path / "one.2.pmk")
    shutil.copy(tmp_path / "one.2.pmk", tmp_path / "copy.pmk")
    with pytest.raises(ValueError, match=r"has ids that are in shard one.2"):
        city.add_shard(tmp_path / "copy.pmk")
    with pytest.raises(KeyError):
        city.remove_shard("two")


def test_a_replaced_version_is_read_anew(one: Path, tmp_path: Path) -> None:
    split_file(one, tmp_path, parts=3)
    city = pm.ShardedMap(tmp_path)
    for path in tmp_path.glob("one.*"):
        path.unlink()
    shutil.copy(one, tmp_path / "other.pmk")
    split_file(tmp_path / "other.pmk", tmp_path, parts=2)
    same(city.search(QUERIES), pm.open(one).search(QUERIES))
    assert [shard.name for shard in city.shards] == ["other.0", "other.1"]


def test_what_does_not_fit_is_refused(one: Path, tmp_path: Path, encoder: pm.Encoder) -> None:
    split_file(one, tmp_path, parts=3)
    path = tmp_path / "one.1.pmk"
    content = path.read_bytes()
    other = pm.PrototypeMap(encoder)
    other.add([5], random_descriptors(1))
    other.save(tmp_path / "other.pmk")
    for change, message in (
        (lambda: path.write_bytes(content[:-7]), r"one.1.pmk has .* bytes, but its manifest says"),
        (lambda: path.write_bytes(content[::-1]), r"one.1.pmk is no map file"),
        (
            lambda: path.write_bytes(content[:70] + b"x" + content[71:]),
            r"one.1.pmk is another file than its manifest says",
        ),
    ):
        change()
        with pytest.raises(ValueError, match=message):
            pm.ShardedMap(tmp_path).search(QUERIES)
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(pm.FileError):
        pm.ShardedMap(tmp_path).verify()
    path.write_bytes(content)
    city = pm.ShardedMap(tmp_path)
    with pytest.raises(ValueError, match="is of encoder 'tiny' with 12 numbers"):
        city.add_shard(tmp_path / "other.pmk")
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    good = Manifest.parse(json.dumps(manifest))
    for key, value, message in (
        ("format", "x", "no manifest of shards"),
        ("version", 2, "version 2, but this Protomark reads 1"),
        ("shards", [], "no shards"),
        ("shards", manifest["shards"][:1] * 2, "two shards have one name"),
        ("shards", [{}], "broken manifest"),
        ("shards", [manifest["shards"][0] | {"landmarks": 10**9}], "counts that cannot be"),
        ("shards", 3, "broken manifest"),
    ):
        with pytest.raises(ValueError, match=message):
            Manifest.parse(json.dumps(manifest | {key: value}))
    outside = manifest["shards"][0] | {"learning": {"name": "../a", "bytes": 1, "identity": ""}}
    with pytest.raises(ValueError, match="outside the folder"):
        Manifest.parse(json.dumps(manifest | {"shards": [outside]}))
    assert len(good.shards) == 3
    manifest["shards"][0]["landmarks"] += 1
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(ValueError, match=r"has 100 landmarks, its manifest says 101"):
        pm.ShardedMap(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"holds no manifest.json"):
        pm.ShardedMap(tmp_path.parent)
    (tmp_path / "manifest.json").write_text("{}")
    with pytest.raises(ValueError, match=r"manifest.json is no manifest of shards"):
        split_file(one, tmp_path, parts=2)


def test_what_is_visible(shards: Path, one: Path) -> None:
    """Boxes are asked before landmarks, and none is missed."""
    whole, city = pm.open(one), pm.ShardedMap(shards)
    positions = whole.positions(whole.ids)

    def test(points: Any, off: float) -> Any:
        return np.linalg.norm(points - [5, 0, 0], axis=1) <= 6 + off

    assert np.array_equal(np.sort(city.visible(test)), whole.ids[test(positions, 0.0)])


@settings(max_examples=30)
@given(st.data())
def test_any_cut_gives_the_same_answers(one: Path, data: st.DataObject) -> None:
    whole = pm.open(one)
    assert isinstance(whole, pm.PrototypeMap)
    label = data.draw(st.lists(st.integers(0, 4), min_size=300, max_size=300))
    parts = [whole.part(ids) for i in range(5) if len(ids := whole.ids[np.array(label) == i])]
    k = data.draw(st.integers(1, 5))
    same(merged([part.search(QUERIES, k) for part in parts], k), whole.search(QUERIES, k))


def test_poses_and_matches_are_those_of_one_map(tmp_path: Path) -> None:
    """On the sample, with a frame that the map has not seen, with and without a prior."""
    pytest.importorskip("poselib")
    pytest.importorskip("pycolmap")
    toy = sample.load()
    rows = toy.keypoints_of(40)
    others = toy.where(toy.keyframe_of_keypoint != 40)
    scene = build_map(others, pm.Encoder.load("freak"))
    scene.save(tmp_path / "one.pmk")
    split_file(tmp_path / "one.pmk", tmp_path / "city", cell_size=4.0)
    city = pm.ShardedMap(tmp_path / "city")
    assert len(city.shards) > 5
    descriptors, camera = toy.descriptors[rows], next(iter(toy.cameras.values()))
    found, right = pm.match(city, descriptors), pm.match(scene, descriptors)
    for name in ("keypoints", "landmarks", "probabilities"):
        assert np.array_equal(getattr(found, name), getattr(right, name))
    for prior in (None, pm.PosePrior(toy.cam_from_world[40], 0.5, 5.0)):
        poses = [
            pm.Localizer(one).localize_features(toy.keypoints[rows], descriptors, camera, prior)
            for one in (scene, city, tmp_path / "city")
        ]
        for pose in poses:
            assert pose.cam_from_world is not None
            assert np.array_equal(pose.cam_from_world, poses[0].cam_from_world)
            assert pose.confidence == poses[0].confidence
