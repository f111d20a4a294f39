"""The split of the paper's protocol."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation_scene import ring_scene
from protomark.evaluation.protocol import SplitKind, split
from protomark.tracks.file import Tracks


@st.composite
def any_tracks(draw: st.DrawFn) -> Tracks:
    """Keyframes with random keypoints, some of which observe random landmarks."""
    keyframes = draw(st.integers(2, 30))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    per_frame = rng.integers(0, 15, keyframes)
    n = int(per_frame.sum())
    ids = np.sort(rng.choice(10_000, draw(st.integers(1, 20)), replace=False))
    whole = ring_scene(keyframes=2, landmarks=1, clutter=n)
    return replace(
        whole,
        keyframe_names=[str(i) for i in range(keyframes)],
        keyframe_camera=np.ones(keyframes, np.int32),
        cam_from_world=np.tile(np.eye(3, 4), (keyframes, 1, 1)),
        offsets=np.concatenate([[0], np.cumsum(per_frame)]),
        keypoints=whole.keypoints[:n],
        descriptors=whole.descriptors[:n],
        landmark_of_keypoint=np.where(rng.random(n) < 0.7, rng.choice(ids, n), -1),
        landmark_ids=ids,
        landmark_positions=np.zeros((len(ids), 3)),
    )


def keyframes_of(keyframes: int, seed: int, kind: SplitKind) -> tuple[list[int], list[int]]:
    """Support and query keyframes, by the definition."""
    rng = np.random.default_rng(seed)
    if kind == "random":
        size = min(max(int(0.9 * keyframes + 0.5), 1), keyframes - 1)
        order = rng.permutation(keyframes)
        return sorted(order[:size]), sorted(order[size:])
    cut = int(rng.integers(keyframes // 2, 7 * keyframes // 10 + 1))
    return list(range(cut)), list(range(cut + keyframes // 10, keyframes))


@pytest.mark.parametrize("kind", ["random", "later"])
@given(tracks=any_tracks(), seed=st.integers(0, 5), most=st.integers(1, 40))
def test_split_against_its_definition(
    kind: SplitKind, tracks: Tracks, seed: int, most: int
) -> None:
    support_keyframes, query_keyframes = keyframes_of(len(tracks.keyframe_names), seed, kind)
    supported = np.isin(tracks.keyframe_of_keypoint, support_keyframes)
    asked = np.isin(tracks.keyframe_of_keypoint, query_keyframes)
    landmark = tracks.landmark_of_keypoint
    counts = {i: int((landmark[supported] == i).sum()) for i in tracks.landmark_ids.tolist()}
    in_map = [i for i, count in counts.items() if count >= 2]
    support_rows = np.flatnonzero(supported & np.isin(landmark, in_map))
    askable = np.flatnonzero(asked & np.isin(landmark, in_map))
    if not len(askable):
        with pytest.raises(ValueError, match="no query keyframe observes a landmark with 2"):
            split(tracks, seed, kind, max_queries=most)
        return
    part = split(tracks, seed, kind, max_queries=most)
    assert part.support_keyframes.tolist() == support_keyframes
    assert part.query_keyframes.tolist() == query_keyframes
    assert np.array_equal(part.support_rows, support_rows)
    assert np.isin(part.query_rows, askable).all()
    assert len(part.query_rows) == min(most, len(askable))
    assert (np.diff(part.query_rows) > 0).all()


@pytest.mark.parametrize("keyframes", [2, 3, 9, 10, 11, 30, 85, 160])
def test_revisits_come_after_the_map(keyframes: int) -> None:
    tracks = ring_scene(keyframes=keyframes, landmarks=200, clutter=0)
    cuts = set()
    for seed in range(20):
        part = split(tracks, seed, "later", min_observations=1)
        last, first = part.support_keyframes[-1], part.query_keyframes[0]
        assert last + 1 + keyframes // 10 == first
        assert part.query_keyframes[-1] == keyframes - 1
        assert 0.5 * keyframes - 1 < last + 1 <= 0.7 * keyframes
        frames = tracks.keyframe_of_keypoint
        assert frames[part.support_rows].max() <= last < first <= frames[part.query_rows].min()
        cuts.add(int(last))
    assert len(cuts) == 7 * keyframes // 10 - keyframes // 2 + 1 or len(cuts) > 8


def test_a_camera_that_never_comes_back() -> None:
    tracks = ring_scene(keyframes=10)
    landmark = tracks.landmark_of_keypoint.copy()
    # The keyframes of the second half see nothing that the first half saw.
    landmark[(landmark < 200) == (tracks.keyframe_of_keypoint < 5)] = -1
    drive = replace(tracks, landmark_of_keypoint=landmark)
    cut = next(s for s in range(20) if len(split(tracks, s, "later").support_keyframes) == 5)
    with pytest.raises(ValueError, match=rf"later split, seed {cut}\), so the camera never comes"):
        split(drive, cut, "later")


@pytest.mark.parametrize("kind", ["random", "later"])
def test_the_same_seed_gives_the_same_split_and_another_one_another(kind: SplitKind) -> None:
    tracks = ring_scene()
    first, again, other = (split(tracks, seed, kind) for seed in (0, 0, 1))
    for name in ("support_keyframes", "query_keyframes", "support_rows", "query_rows"):
        assert np.array_equal(getattr(first, name), getattr(again, name))
    assert not np.array_equal(first.query_keyframes, other.query_keyframes)


def test_the_split_is_the_one_that_published_figures_stand_on() -> None:
    """The split must not change: figures in docs/ are of these keyframes on every platform."""
    assert split(ring_scene(), 0).query_keyframes.tolist() == [1, 15]
    assert split(ring_scene(), 1).query_keyframes.tolist() == [6, 19]
    assert split(ring_scene(), 0, "later").query_keyframes.tolist() == [16, 17, 18, 19]


def test_queries_are_a_random_draw_of_all() -> None:
    tracks = ring_scene(keyframes=40, landmarks=600)
    every = split(tracks, 0)
    some = split(tracks, 0, max_queries=300)
    keyframes = tracks.keyframe_of_keypoint[some.query_rows]
    assert len(some.query_rows) == 300 < len(every.query_rows)
    assert np.isin(some.query_rows, every.query_rows).all()
    assert set(keyframes.tolist()) == set(every.query_keyframes.tolist())


@settings(max_examples=20)
@given(share=st.floats(0.01, 0.99))
def test_either_side_has_a_keyframe(share: float) -> None:
    part = split(ring_scene(keyframes=6), 0, support_share=share, min_observations=1)
    assert len(part.support_keyframes) == min(max(int(6 * share + 0.5), 1), 5)


def test_one_keyframe_cannot_be_split() -> None:
    with pytest.raises(ValueError, match="give tracks of at least 2"):
        split(ring_scene(keyframes=1), 0)


def test_tracks_without_queries_are_refused() -> None:
    tracks = ring_scene()
    lonely = replace(tracks, landmark_of_keypoint=np.full(len(tracks.keypoints), -1))
    with pytest.raises(ValueError, match="no query keyframe observes a landmark with 2"):
        split(lonely, 0)
