"""All methods on the same queries of one sequence."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protomark.evaluation import pose
from protomark.evaluation.methods import MethodChoice
from protomark.evaluation.methods.method import Method
from protomark.evaluation.protocol import Split, split
from protomark.evaluation.results import MethodResult, SequenceResult
from protomark.evaluation.support import Support
from protomark.evaluation.threads import one_blas_thread
from protomark.tracks.file import Tracks

TIMED_QUERIES = 1000
POSE_FRAMES = 20


@dataclass(frozen=True)
class Options:
    """How an evaluation runs.

    Attributes:
        seeds: seeds of the splits.
        pose_frames: query keyframes to localize at each seed, at most.
        threads: threads for all that is not timed.
    """

    seeds: Sequence[int] = (0, 1, 2)
    pose_frames: int = POSE_FRAMES
    threads: int = 1


def evaluate(
    tracks: Tracks,
    sequence: str,
    methods: Sequence[MethodChoice],
    options: Options,
    *,
    own: Tracks | None = None,
    discriminant: str = "support",
    advance: Callable[[str], None] = lambda _: None,
) -> SequenceResult:
    """Precision, pose recall and search time of each method at each seed.

    Args:
        tracks: the sequence.
        sequence: its name, for the tables.
        methods: what to compare.
        options: seeds, frames and threads.
        own: the same sequence with the descriptors that Protomark's own methods take, if others
            than those of `tracks`.
        discriminant: what the linear discriminants are learned from, for the record.
        advance: called with the method's label before each method at each seed.
    """
    own = own or tracks
    results = [MethodResult(choice.name, choice.label, choice.family) for choice in methods]
    sizes = []
    depth = pose.scene_depth(tracks)
    for seed in options.seeds:
        part = split(tracks, seed)
        sources = [tracks] if own is tracks else [tracks, own]
        # The same keypoints either way; only the bytes of their descriptors may differ.
        supports = {
            id(source): Support(
                tracks.landmark_of_keypoint[part.support_rows],
                source.descriptors[part.support_rows],
                seed,
            )
            for source in sources
        }
        frames = {id(t): draw_frames(t, part, options.pose_frames) for t in sources}
        support = supports[id(tracks)]
        sizes.append((len(support.ids), len(part.support_rows), len(part.query_rows)))
        for choice, result in zip(methods, results, strict=True):
            advance(choice.label)
            source = own if choice.is_own else tracks
            began = time.perf_counter()
            # Small matrices: more BLAS threads cost more in waiting than they bring.
            with one_blas_thread():
                method = choice.build(supports[id(source)])
            result.build_s.append(time.perf_counter() - began)
            result.bytes_per_landmark.append(method.bytes_per_landmark)
            measure_precision(source, part, method, options.threads, result)
            measure_poses(source, frames[id(source)], depth, method, options.threads, result)
    landmarks, observations, queries = np.mean(sizes, axis=0)
    return SequenceResult(
        sequence=sequence,
        descriptor=tracks.descriptor,
        keyframes=len(tracks.keyframe_names),
        landmarks=len(tracks.landmark_ids),
        observations=len(tracks.observations),
        map_landmarks=float(landmarks),
        support_observations=float(observations),
        queries=float(queries),
        scene_depth=depth,
        seeds=list(options.seeds),
        discriminant=discriminant,
        methods=results,
    )


def draw_frames(tracks: Tracks, part: Split, at_most: int) -> list[pose.Frame]:
    """Up to `at_most` of the query keyframes, drawn at random, in order."""
    chosen = part.query_keyframes
    if len(chosen) > at_most:
        rng = np.random.default_rng(part.seed)
        chosen = np.sort(rng.choice(chosen, size=at_most, replace=False))
    return [pose.Frame.of(tracks, int(keyframe)) for keyframe in chosen]


def measure_precision(
    tracks: Tracks, part: Split, method: Method, threads: int, result: MethodResult
) -> None:
    """Add the share of right answers, and the time of the first queries on one thread."""
    queries = tracks.descriptors[part.query_rows]
    true = tracks.landmark_of_keypoint[part.query_rows]
    # Queries are sorted by keyframe; an even draw is as hard as the whole.
    timed = np.unique(np.linspace(0, len(queries) - 1, TIMED_QUERIES).astype(np.int64))
    began = time.perf_counter()
    answers, _ = method.match(queries[timed], threads=1)
    seconds = time.perf_counter() - began
    result.search_ms.append(1000 * seconds * (1000 / len(timed)))

    rest = np.setdiff1d(np.arange(len(queries)), timed, assume_unique=True)
    correct = int((answers[:, 0] == true[timed]).sum())
    if len(rest):
        answers, _ = method.match(queries[rest], threads=threads)
        correct += int((answers[:, 0] == true[rest]).sum())
    result.precision.append(correct / len(queries))


def measure_poses(
    tracks: Tracks,
    frames: Sequence[pose.Frame],
    depth: float,
    method: Method,
    threads: int,
    result: MethodResult,
) -> None:
    """Add how many frames were localized, and how many accepted matches were right."""
    if not frames:
        return
    ends = np.cumsum([len(frame.keypoints) for frame in frames])
    landmarks, distances = method.match(
        np.concatenate([frame.descriptors for frame in frames]), threads=threads
    )
    for frame, end in zip(frames, ends, strict=True):
        rows = slice(int(end) - len(frame.keypoints), int(end))
        matches = pose.accept(landmarks[rows], distances[rows])
        positions = positions_of(tracks, matches.landmarks)
        result.frames += 1
        result.accepted += len(matches.landmarks)
        result.right += int(pose.right(frame, matches, positions).sum())
        result.found += pose.localize(frame, matches, positions).found(depth)


def positions_of(tracks: Tracks, landmarks: NDArray[np.int64]) -> NDArray[np.float64]:
    """(n,) landmark ids that the tracks hold -> (n, 3) positions."""
    return tracks.landmark_positions[np.searchsorted(tracks.landmark_ids, landmarks)]
