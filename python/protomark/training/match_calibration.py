"""Fits the match calibration of an encoder to frames whose landmarks are known."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.evaluation.frames import FrameMatches, QueryFrame, right_matches
from protomark.evaluation.protocol import split
from protomark.evaluation.run import draw_frames
from protomark.maps.build import tracks_for
from protomark.match_calibration import (
    MatchCalibration,
    calibration_features,
    fit_logistic,
    with_calibration,
)
from protomark.matching import MIN_PROBABILITY
from protomark.progress import Progress, silent, tracked
from protomark.tracks.file import Tracks, sequence_name

FRAMES = 40
Search = Callable[[NDArray[np.uint8]], tuple[NDArray[np.int64], NDArray[np.int32]]]


@dataclass(frozen=True)
class LabelledMatches:
    """The nearest landmarks of all n keypoints of several frames."""

    distances: NDArray[np.float64]  # (n, 2) float64, squared distances to the two nearest landmarks
    # (n,) bool, whether the nearest landmark is the true one, or projects to within half a percent
    # of the image's longer side.
    right: NDArray[np.bool_]
    frame: NDArray[np.int64]  # (n,) int64, index of each keypoint's frame


def label_matches(tracks: Tracks, frames: Sequence[QueryFrame], search: Search) -> LabelledMatches:
    """Search a map of `tracks` for every keypoint of `frames`."""
    distances, right, number = [], [], []
    for i, frame in enumerate(frames):
        ids, squared = search(frame.descriptors)
        rows = np.flatnonzero(ids[:, 0] >= 0)
        matches = FrameMatches(rows, ids[rows, 0])
        right.append(right_matches(frame, matches, tracks.positions_of(matches.landmarks)))
        distances.append(squared[rows, :2].astype(np.float64))
        number.append(np.full(len(rows), i))
    return LabelledMatches(np.concatenate(distances), np.concatenate(right), np.concatenate(number))


def fit_calibration(sequences: Sequence[LabelledMatches]) -> MatchCalibration:
    """The calibration that fits the matches of sequences best, each with the same weight."""
    distances = np.concatenate([m.distances for m in sequences])
    right = np.concatenate([m.right for m in sequences])
    weights = np.concatenate([np.full(len(m.right), 1 / len(m.right)) for m in sequences])
    features = calibration_features(distances[:, 0], distances[:, 1])
    return MatchCalibration(tuple(float(w) for w in fit_logistic(features, right, weights)))


def held_out_frames(
    tracks: Tracks, frames: int = FRAMES, seed: int = 0
) -> tuple[NDArray[np.int64], list[QueryFrame]]:
    """Keypoint rows that build a map, and frames to query it with.

    A random tenth of the keyframes are queries, as in `protomark evaluate`.
    """
    part = split(tracks, seed)
    return part.support_rows, draw_frames(tracks, part, frames)


def matches_by_kind(
    encoder: pm.Encoder, tracks: Tracks, frames: int = FRAMES, seed: int = 0, threads: int = 1
) -> dict[tuple[int, bool], LabelledMatches]:
    """Matches with maps of `tracks`, by code length and whether prototypes are tuned."""
    tracks = tracks_for(encoder, tracks)
    rows, queries = held_out_frames(tracks, frames, seed)
    ids, every = tracks.landmark_of_keypoint[rows], encoder.encode(tracks.descriptors[rows])
    found = {}
    for dim in encoder.dims:
        scene, codes = pm.PrototypeMap(encoder, dim), np.ascontiguousarray(every[:, :dim])
        scene.add_codes(ids, codes)
        with tempfile.TemporaryDirectory(prefix="protomark-") as folder:
            # Words of as many numbers have about the same calibration.
            path, size = Path(folder) / "scene.sealed.pmk", 4 * -(-dim // 4) + 1
            tuned = scene.seal(path, ids, codes, bytes_per_landmark=size, threads=threads)
        for of_map in (scene, tuned):
            search = partial(of_map.search, threads=threads)
            found[dim, of_map is tuned] = label_matches(tracks, queries, search)
    return found


@dataclass(frozen=True)
class CalibrationQuality:
    """How well a calibration fits a sequence: another than those that it was fitted to, if any."""

    sequence: str
    dim: int  # code length
    tuned: bool  # whether prototypes are tuned
    right: float  # share of keypoints whose nearest landmark is right
    precision: float  # share of accepted matches that are right
    recall: float  # share of right matches that are accepted
    expected: float  # mean probability of accepted matches, to compare with `precision`


def measure_calibration(
    sequence: str, dim: int, tuned: bool, calibration: MatchCalibration, matches: LabelledMatches
) -> CalibrationQuality:
    """Measure how well a calibration predicts which matches of a sequence are right."""
    probability = calibration.probability(matches.distances)
    accepted = probability >= MIN_PROBABILITY
    right = matches.right[accepted]
    return CalibrationQuality(
        sequence,
        dim,
        tuned,
        float(matches.right.mean()),
        float(right.mean()) if len(right) else 0.0,
        float(right.sum() / max(matches.right.sum(), 1)),
        float(probability[accepted].mean()) if len(right) else 0.0,
    )


def calibrate(
    encoder: pm.Encoder, paths: Sequence[Path], threads: int = 1, progress: Progress = silent
) -> tuple[pm.Encoder, list[CalibrationQuality]]:
    """Fit the match calibration of an encoder, and measure it on each sequence.

    The quality on a sequence is that of a fit to the others, if there are any.
    """
    found: dict[str, dict[tuple[int, bool], LabelledMatches]] = {}
    names = [sequence_name(path) for path in paths]
    for path, name in zip(paths, names, strict=True):
        if names.count(name) > 1:
            raise ValueError(f"{path}: two files are of the sequence {name}, give one of them")
    for path, name in tracked(list(zip(paths, names, strict=True)), progress, "query maps"):
        tracks = Tracks.load(path)
        try:
            found[name] = matches_by_kind(encoder, tracks, threads=threads)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
    quality = []
    for name in found:
        others = [matches for other, matches in found.items() if other != name] or [found[name]]
        for kind, matches in found[name].items():
            fitted = fit_calibration([other[kind] for other in others])
            quality.append(measure_calibration(name, *kind, fitted, matches))
    kinds = next(iter(found.values()), {})
    calibration = {kind: fit_calibration([m[kind] for m in found.values()]) for kind in kinds}
    return with_calibration(encoder, calibration, ", ".join(found)), quality
