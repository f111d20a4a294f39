"""Maps that number their landmarks in worlds of their own: recognized and merged, or refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import protomark as pm
from conftest import protomark
from protomark import sample
from protomark.geometry.similarity import Similarity
from protomark.maps.alignment import align_maps
from protomark.maps.merge import find_alignment, merge_files
from protomark.maps.open import open_learning_map
from protomark.tracks.file import Tracks
from test_similarity import assert_same, random_similarity

MOTION = random_similarity(np.random.default_rng(7), scale=2.5)
SHIFT = 1000  # ids of the second map, which hold no landmark of the first


@pytest.fixture(scope="module")
def tracks() -> Tracks:
    return sample.load()


def observations(tracks: Tracks, frames: range) -> tuple[np.ndarray, np.ndarray]:
    """Landmarks and descriptors in these keyframes."""
    rows = np.concatenate([np.arange(s.start, s.stop) for s in map(tracks.keypoints_of, frames)])
    rows = np.intersect1d(rows, tracks.observations)
    return tracks.landmark_of_keypoint[rows], tracks.descriptors[rows]


def half(tracks: Tracks, frames: range, motion: Similarity | None = None) -> pm.PrototypeMap:
    """The map of some keyframes; with a motion its ids run backward, in a world of its own."""
    ids, descriptors = observations(tracks, frames)
    scene = pm.PrototypeMap(pm.Encoder.load("freak"), 32)
    positions = tracks.positions_of(np.unique(ids))
    if motion is not None:
        ids = tracks.landmark_ids[-1] - ids
        positions = motion.inverse()(positions)[::-1]
    scene.add(ids, descriptors)
    scene.set_positions(scene.ids, positions)
    return scene


@pytest.fixture(scope="module")
def halves(tracks: Tracks, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The even and the odd keyframes: the same landmarks, no observation in common."""
    folder = tmp_path_factory.mktemp("halves")
    count = len(tracks.keyframe_names)
    half(tracks, range(0, count, 2)).save(folder / "even.pmk")
    half(tracks, range(1, count, 2), MOTION).save(folder / "odd.pmk")
    return folder / "even.pmk", folder / "odd.pmk"


def test_a_map_is_recognized_and_moved(
    tracks: Tracks, halves: tuple[Path, Path], tmp_path: Path
) -> None:
    even, odd = map(open_learning_map, halves)
    found = find_alignment(even, odd)
    assert found is not None
    assert_same(found.similarity, MOTION, 1e-6)
    last = int(tracks.landmark_ids[-1])
    right = found.into == last - found.source
    assert right.mean() > 0.97
    assert right.sum() > 0.5 * np.isin(last - odd.ids, even.ids).sum()

    output, report, picture = (tmp_path / name for name in ("out.pmk", "out.json", "out.svg"))
    done = protomark("merge", *halves, "-o", output, "--json", report, "--draw", picture)
    assert done.returncode == 0, done.stderr
    assert "likely pairs agree" in " ".join(done.stdout.split())
    assert picture.read_text().count("<svg") == 1
    facts = json.loads(report.read_text())["inputs"][1]
    assert facts["in_common"] == facts["moved"]["duplicates"] == len(found.into)

    # Exactly the map of all observations, in which the duplicates had one id from the beginning.
    ids, descriptors = observations(tracks, range(1, len(tracks.keyframe_names), 2))
    new = odd.ids + even.ids[-1] + 1
    new[np.searchsorted(odd.ids, found.source)] = found.into
    even.add(new[np.searchsorted(odd.ids, last - ids)], descriptors)
    merged = pm.open(output)
    np.testing.assert_array_equal(merged.ids, even.ids)
    added = np.setdiff1d(new, found.into)
    true = tracks.positions_of(last - odd.ids[~np.isin(new, found.into)])
    np.testing.assert_allclose(merged.positions(added), true, atol=1e-5)
    even.set_positions(added, merged.positions(added))
    even.save(tmp_path / "together.pmk")
    assert (tmp_path / "together.pmk").read_bytes() == output.read_bytes()


def test_a_map_may_join_others_that_have_nothing_in_common(tracks: Tracks, tmp_path: Path) -> None:
    count = len(tracks.keyframe_names)
    paths = [tmp_path / f"{name}.pmk" for name in "abc"]
    first, second = (half(tracks, frames) for frames in (range(0, 30), range(55, count)))
    # Of one object seen all round, parts that are far apart.
    second.remove(np.intersect1d(first.ids, second.ids))
    ids = second.ids[::-1]
    renumbered = pm.PrototypeMap(second.encoder, second.dim)
    renumbered.merge_map(second, into=np.arange(len(ids)), source=ids)
    renumbered.set_positions(np.arange(len(ids)), MOTION(second.positions(ids)))
    first.save(paths[0])
    renumbered.save(paths[1])
    half(tracks, range(count), random_similarity(np.random.default_rng(11))).save(paths[2])
    with pytest.raises(ValueError, match=f"{paths[1]}: .*cannot be recognized"):
        merge_files(paths[:2], tmp_path / "out.pmk")
    merged = merge_files(paths, tmp_path / "out.pmk")
    assert [one["file"] for one in merged.facts["inputs"]] == [str(paths[i]) for i in (0, 2, 1)]


def test_scale_is_kept_if_asked(halves: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cannot be recognized"):
        merge_files(halves, tmp_path / "out.pmk", fixed_scale=True)
    odd = open_learning_map(halves[1])
    odd.set_positions(odd.ids, MOTION.scale * odd.positions(odd.ids))
    found = find_alignment(open_learning_map(halves[0]), odd, fixed_scale=True)
    assert found is not None
    assert found.similarity.scale == 1


def test_texts_are_true_in_the_world_of_the_first(
    halves: tuple[Path, Path], tmp_path: Path
) -> None:
    lines = ["SIMPLE_RADIAL 640 480 500 320 240 0", "SIMPLE_RADIAL 640 480 700 320 240 0"]
    for path, line, name in zip(halves, lines, "ab", strict=True):
        scene = open_learning_map(path)
        scene.metadata = {"frame": "ENU, metres", "cameras": f"1 {line}\n", "robot": name}
        scene.save(tmp_path / f"{name}.pmk")
    for first, others in (("a", ["ENU, metres", "a"]), ("even", [None, "b"])):
        path = halves[0] if first == "even" else tmp_path / "a.pmk"
        merge_files([path, tmp_path / "b.pmk"], tmp_path / "out.pmk")
        texts = pm.open(tmp_path / "out.pmk").metadata
        assert [texts.get("frame"), texts["robot"]] == others
        expected = lines if first == "a" else lines[1:]
        assert [line.partition(" ")[2] for line in texts["cameras"].splitlines()] == expected


def test_parts_of_one_map_stay_where_they_are(
    tracks: Tracks, halves: tuple[Path, Path], tmp_path: Path
) -> None:
    """Ids that differ, of landmarks some of which look alike: they are summed."""
    even = open_learning_map(halves[0])
    copy = pm.PrototypeMap(even.encoder, even.dim)
    copy.merge_map(even, into=even.ids + 10**6, source=even.ids)
    assert find_alignment(even, copy) is None
    # Elsewhere, they may be of another world.
    copy.set_positions(copy.ids, MOTION.inverse()(copy.positions(copy.ids)))
    with pytest.warns(UserWarning, match="look like landmarks elsewhere .* --align"):
        assert find_alignment(even, copy) is None
    found = find_alignment(even, copy, align=True)
    assert found is not None
    assert len(found.into) == len(even)
    assert (found.source == found.into + 10**6).all()


def test_other_places_are_refused(
    tracks: Tracks, halves: tuple[Path, Path], tmp_path: Path
) -> None:
    even = halves[0]
    rng = np.random.default_rng(8)
    other = half(tracks, range(0, 40), MOTION)
    mirrored, shuffled, few, noise, unplaced = (tmp_path / f"{n}.pmk" for n in "mspnu")
    ids = other.ids
    positions = other.positions(ids)
    other.set_positions(ids, positions * [1, 1, -1])
    other.save(mirrored)
    other.set_positions(ids, rng.permutation(positions))
    other.save(shuffled)
    other.set_positions(ids, positions)
    other.part(ids[:40:4]).save(few)
    other.set_positions(ids, np.full((len(ids), 3), np.nan))
    other.save(unplaced)
    random = pm.PrototypeMap(other.encoder, 32)
    random.add(ids, rng.integers(0, 256, (len(ids), 64), dtype=np.uint8))
    random.set_positions(ids, positions)
    random.save(noise)
    output = tmp_path / "out.pmk"
    for path, reason in (
        (mirrored, "one is mirrored"),
        (shuffled, "landmarks that look alike too few agree"),
        (noise, "landmarks (that )?look alike"),
        (unplaced, "0 landmarks of a map have a position"),
    ):
        with pytest.raises(ValueError, match=f"{path}: .*stand for other landmarks .*{reason}"):
            merge_files([even, path], output)
        assert not output.exists()
    with pytest.raises(ValueError, match="cannot be recognized") as caught:
        find_alignment(open_learning_map(even), open_learning_map(noise))
    assert "--renumber" not in str(caught.value)  # it is for files
    with pytest.raises(ValueError, match="10 landmarks of a map have a position, too few"):
        align_maps(open_learning_map(even), open_learning_map(few))


def test_places_that_share_an_object_are_refused(
    tracks: Tracks, halves: tuple[Path, Path], tmp_path: Path
) -> None:
    """The same poster hangs in two rooms: its landmarks agree, and all around it none does."""
    even, odd = map(open_learning_map, halves)
    rng = np.random.default_rng(9)
    found = align_maps(even, odd)
    middle = np.median(even.positions(found.into), axis=0)
    order = np.argsort(np.linalg.norm(even.positions(found.into) - middle, axis=1))
    poster = odd.part(found.source[order[:80]])
    rest = np.setdiff1d(odd.ids, poster.ids)
    poster.add(rest, rng.integers(0, 256, (len(rest), 64), dtype=np.uint8))
    poster.set_positions(rest, odd.positions(rest))
    alike = align_maps(even, poster)
    assert_same(alike.similarity, MOTION, 0.05)
    assert "places may only look alike" in alike.problem
    poster.save(tmp_path / "poster.pmk")
    with pytest.raises(ValueError, match="only look alike"):
        merge_files([halves[0], tmp_path / "poster.pmk"], tmp_path / "out.pmk")
