"""Evaluates methods on the same queries of each sequence."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import protomark as pm
from protomark import models
from protomark.baselines.method import Method
from protomark.baselines.support import Moments, Support
from protomark.evaluation.frames import (
    QueryFrame,
    localize_frame,
    right_matches,
    scene_depth,
    select_matches,
)
from protomark.evaluation.methods import MethodChoice, choose_methods, method_choices
from protomark.evaluation.protocol import SplitKind, SupportQuerySplit, split
from protomark.evaluation.results import MethodResult, SequenceResult
from protomark.features.upright import SUFFIX
from protomark.progress import Progress, silent
from protomark.threads import one_blas_thread
from protomark.tracks.file import Tracks, sequence_name

TIMED_QUERIES = 1000
POSE_FRAMES = 20
# Frames that observe fewer landmarks of the map are not asked for their pose.
MIN_COMMON = 20


@dataclass(frozen=True)
class EvaluationOptions:
    """How an evaluation runs."""

    split: SplitKind = "random"
    seeds: Sequence[int] = (0, 1, 2)  # seeds of the splits
    pose_frames: int = POSE_FRAMES  # limit on query keyframes to localize per seed
    threads: int = 1  # threads for all that is not timed
    # Names or files of encoders, for the tracks' descriptors or their upright forms; by default the
    # one that ships for the descriptor.
    encoders: Sequence[str] = ()
    # Names of methods, or of families of methods; by default the default ones.
    methods: Sequence[str] = ()
    # Tracks files to learn linear discriminants from; by default each sequence's support.
    discriminant_from: Sequence[Path] = ()


def evaluate_files(
    paths: Sequence[Path], options: EvaluationOptions, progress: Progress = silent
) -> Iterator[SequenceResult]:
    """Evaluate tracks files one after the other."""
    encoders = [pm.Encoder.load(source) for source in options.encoders or models.names()]
    for path in [*paths, *options.discriminant_from]:
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such tracks file")
    learned: dict[tuple[str, str, int], Moments | None] = {}
    for path in paths:
        tracks = Tracks.load(path)
        kind = (tracks.descriptor, tracks.input, tracks.bits)
        if kind not in learned:
            sources = options.discriminant_from
            learned[kind] = learn_moments(sources, tracks) if sources else None
        fitting = encoders_for(tracks, encoders, given=bool(options.encoders))
        choices = method_choices(
            fitting, learned[kind], options.threads, tracks.width, tracks.input
        )
        chosen = choose_methods(choices, options.methods)
        yield evaluate(tracks, sequence_name(path), chosen, options, progress)


def encoders_for(
    tracks: Tracks, encoders: Sequence[pm.Encoder], *, given: bool
) -> list[pm.Encoder]:
    """The encoders that take the descriptors of the tracks, or their upright form.

    Unless the user gave them, only the one for what described the images counts.
    """
    kind = (tracks.descriptor, tracks.input, tracks.bits)
    if not given:
        encoders = [encoder for encoder in encoders if encoder.name == tracks.encoder_name]
    fitting = [e for e in encoders if (e.descriptor, e.input, e.bits) == kind]
    return fitting + [e for e in encoders if e.descriptor == tracks.descriptor + SUFFIX]


def learn_moments(paths: Sequence[Path], like: Tracks) -> Moments:
    """Moments over several tracks files, of landmarks with at least two observations."""
    landmarks, descriptors, offset = [], [], 0
    for path in paths:
        tracks = Tracks.load(path)
        if any(getattr(tracks, k) != getattr(like, k) for k in ("descriptor", "input", "bits")):
            raise ValueError(
                f"{path} holds {tracks.descriptor} with {tracks.bits} bits, but the tracks to "
                f"evaluate {like.descriptor} with {like.bits}: give tracks of the same descriptor"
            )
        rows = tracks.observations
        index = np.searchsorted(tracks.landmark_ids, tracks.landmark_of_keypoint[rows])
        repeated = np.bincount(index, minlength=len(tracks.landmark_ids))[index] >= 2
        landmarks.append(index[repeated] + offset)
        descriptors.append(tracks.descriptors[rows[repeated]])
        offset += len(tracks.landmark_ids)
    return Support(np.concatenate(landmarks), np.concatenate(descriptors), kind=like.input).moments


def evaluate(
    tracks: Tracks,
    sequence: str,
    methods: Sequence[MethodChoice],
    options: EvaluationOptions,
    progress: Progress = silent,
) -> SequenceResult:
    """Measure precision, pose recall and search time of each method at each seed.

    `progress` is called with each method's label at each seed.
    """
    results = [MethodResult(choice.name, choice.label, choice.family) for choice in methods]
    # Plain and upright tracks have the same keypoints, but other descriptors.
    sources = {False: tracks}
    if any(choice.upright for choice in methods):
        sources[True] = tracks.upright()
    depth = scene_depth(tracks)
    sizes, done = [], 0
    for seed in options.seeds:
        part = split(tracks, seed, options.split)
        landmarks = tracks.landmark_of_keypoint[part.support_rows]
        supports = {
            upright: Support(landmarks, source.descriptors[part.support_rows], seed, source.input)
            for upright, source in sources.items()
        }
        frames = {
            upright: draw_frames(source, part, options.pose_frames)
            for upright, source in sources.items()
        }
        sizes.append((len(supports[False].ids), len(part.support_rows), len(part.query_rows)))
        for choice, result in zip(methods, results, strict=True):
            stage = f"{sequence}, {choice.label}"
            progress(stage, done, len(methods) * len(options.seeds))
            done += 1
            began = time.perf_counter()
            # For small matrices more BLAS threads wait longer than they save.
            with one_blas_thread():
                method = choice.build(supports[choice.upright])
            result.build_s.append(time.perf_counter() - began)
            result.bytes_per_landmark.append(method.bytes_per_landmark)
            source = sources[choice.upright]
            measure_precision(source, part, method, options.threads, result)
            measure_poses(source, frames[choice.upright], depth, method, options.threads, result)
    mean_landmarks, observations, queries = np.mean(sizes, axis=0)
    return SequenceResult(
        sequence=sequence,
        descriptor=tracks.descriptor,
        split=options.split,
        keyframes=len(tracks.keyframe_names),
        landmarks=len(tracks.landmark_ids),
        observations=len(tracks.observations),
        map_landmarks=float(mean_landmarks),
        support_observations=float(observations),
        queries=float(queries),
        scene_depth=depth,
        seeds=list(options.seeds),
        discriminant=", ".join(p.name for p in options.discriminant_from) or "support",
        methods=results,
    )


def draw_frames(tracks: Tracks, part: SupportQuerySplit, limit: int) -> list[QueryFrame]:
    """Up to `limit` query keyframes that see part of the map, drawn at random, in order."""
    in_map = np.isin(
        tracks.landmark_of_keypoint, np.unique(tracks.landmark_of_keypoint[part.support_rows])
    )
    common = np.bincount(tracks.keyframe_of_keypoint[in_map], minlength=len(tracks.keyframe_names))
    chosen = part.query_keyframes[common[part.query_keyframes] >= MIN_COMMON]
    if len(chosen) > limit:
        rng = np.random.default_rng(part.seed)
        chosen = np.sort(rng.choice(chosen, size=limit, replace=False))
    return [QueryFrame.of(tracks, int(keyframe)) for keyframe in chosen]


def measure_precision(
    tracks: Tracks, part: SupportQuerySplit, method: Method, threads: int, result: MethodResult
) -> None:
    """Add the precision, and the time of a sample of queries on one thread, to a result."""
    queries = tracks.descriptors[part.query_rows]
    true = tracks.landmark_of_keypoint[part.query_rows]
    # Queries are sorted by keyframe, so an evenly spaced sample represents all of them.
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
    frames: Sequence[QueryFrame],
    depth: float,
    method: Method,
    threads: int,
    result: MethodResult,
) -> None:
    """Add the numbers of localized frames, of right matches and of landmarks to a result."""
    for frame in frames:
        answers = method.match(frame.descriptors, threads=threads)
        every = select_matches(*answers, share=1.0)
        found = right_matches(frame, every, tracks.positions_of(every.landmarks))
        result.landmarks_found += int(found.sum())
        matches = select_matches(*answers)
        positions = tracks.positions_of(matches.landmarks)
        result.frames += 1
        result.selected += len(matches.landmarks)
        result.right += int(right_matches(frame, matches, positions).sum())
        result.found += localize_frame(frame, matches, positions).found(depth)
