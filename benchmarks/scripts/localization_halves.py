"""Localizes the second half of a sequence in a map of its first half, by several kinds of map.

python benchmarks/scripts/localization_halves.py TRACKS --calibrate TRACKS...

The kinds are all descriptors of each landmark, one medoid descriptor per landmark (both searched by
Hamming distance), and prototypes. The same code localizes in all of them, and the calibration of
each kind's matches is fitted to the sequences of --calibrate. The map contains the landmarks with
at least two observations in the first half, and prototypes average only those. All kinds of map use
the positions in the tracks file, which were triangulated from all keyframes.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.baselines.binary import medoid
from protomark.baselines.support import Support
from protomark.cli.terminal import progress_bar
from protomark.evaluation.frames import QueryFrame
from protomark.geometry.pose import pose_error
from protomark.localization.batch import THRESHOLDS
from protomark.localization.solve import CANDIDATES, Candidates, solve_pose
from protomark.match_calibration import MatchCalibration
from protomark.matching import MIN_PROBABILITY
from protomark.progress import tracked
from protomark.tracks.file import Tracks
from protomark.training.match_calibration import (
    Search,
    fit_calibration,
    held_out_frames,
    label_matches,
)
from protomark_bench.report import ReportTable

MIN_OBSERVATIONS = 2
# Returns a search for the `CANDIDATES` nearest landmarks, and its bytes per landmark without
# positions.
Builder = Callable[[Support], tuple[Search, float]]


def kinds_of_map(encoder: pm.Encoder, dims: Sequence[int]) -> dict[str, Builder]:
    """Name -> kind of map: all descriptors, medoids, and prototypes of each code length."""

    def all_descriptors(support: Support) -> tuple[Search, float]:
        size = len(support.descriptors) / len(support.ids) * support.descriptors.shape[1] + 1
        return hamming(support.descriptors, support.landmarks), size

    def medoids(support: Support) -> tuple[Search, float]:
        chosen = medoid(support)
        return hamming(chosen.descriptors, chosen.landmarks), chosen.bytes_per_landmark

    def prototypes(dim: int) -> Builder:
        def build(support: Support) -> tuple[Search, float]:
            scene = pm.PrototypeMap(encoder, dim)
            scene.add(support.landmarks, support.descriptors)
            return lambda descriptors: scene.search(descriptors, k=CANDIDATES), dim + 1

        return build

    return {
        "all descriptors": all_descriptors,
        "medoid": medoids,
        **{f"prototypes, {dim}": prototypes(dim) for dim in dims},
    }


def hamming(descriptors: NDArray[np.uint8], landmarks: NDArray[np.int64]) -> Search:
    """Search among binary descriptors."""
    rows = np.ascontiguousarray(descriptors)

    def search(queries: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        ids, bits = pm.hamming_search(queries, rows, k=CANDIDATES, landmarks=landmarks)
        return ids, np.where(ids >= 0, bits**2, bits)  # squared, as a map's distances are

    return search


def calibrated(build: Builder, sequences: Sequence[Tracks], frames: int = 40) -> MatchCalibration:
    """The calibration of this kind of map, fitted to frames of other sequences."""
    given = []
    for tracks in sequences:
        rows, queries = held_out_frames(tracks, frames)
        support = Support(tracks.landmark_of_keypoint[rows], tracks.descriptors[rows])
        given.append(label_matches(tracks, queries, build(support)[0]))
    return fit_calibration(given)


@dataclass(frozen=True)
class HalvesResult:
    """One kind of map on one sequence.

    Attributes:
        bytes_per_landmark: all that matching needs, without the position.
        landmarks: number of landmarks in the map.
        frames: number of frames to localize.
        recall: share of the frames whose pose is within each of `THRESHOLDS`.
        median_error: over all frames, in world units and degrees; infinite without a pose.
        median_inliers: over all frames.
        search_ms, pose_ms: median time per frame on one thread; a search among prototypes
            includes encoding.
    """

    bytes_per_landmark: float
    landmarks: int
    frames: int
    recall: list[float]
    median_error: tuple[float, float]
    median_inliers: float
    search_ms: float
    pose_ms: float


def localize_halves(
    tracks: Tracks,
    build: Builder,
    calibration: MatchCalibration,
    share: float = 0.5,
    stride: int = 1,
) -> HalvesResult:
    """Localizes the later frames of a sequence in a map of its first ones.

    Args:
        tracks: a sequence, its keyframes in order of time.
        build: the kind of map.
        calibration: calibration of this kind's matches.
        share: share of the keyframes that build the map.
        stride: localize every `stride`-th of the other keyframes.

    Raises:
        ValueError: there are too few keyframes or too short tracks.
    """
    keyframes = len(tracks.keyframe_names)
    cut = int(keyframes * share + 0.5)
    rows = tracks.observations
    rows = rows[tracks.keyframe_of_keypoint[rows] < cut]
    landmarks = tracks.landmark_of_keypoint[rows]
    _, inverse, counts = np.unique(landmarks, return_inverse=True, return_counts=True)
    rows = rows[counts[inverse] >= MIN_OBSERVATIONS]
    if not len(rows) or cut >= keyframes:
        raise ValueError(f"{keyframes} keyframes cannot be cut in two: too few or too short tracks")
    support = Support(tracks.landmark_of_keypoint[rows], tracks.descriptors[rows])
    search, size = build(support)
    found, errors, seconds, pose_seconds = [], [], [], []
    for keyframe in range(cut, keyframes, stride):
        frame = QueryFrame.of(tracks, keyframe)
        begin = time.perf_counter()
        ids, distances = search(frame.descriptors)
        seconds.append(time.perf_counter() - begin)
        where = np.searchsorted(tracks.landmark_ids, np.maximum(ids, tracks.landmark_ids[0]))
        positions = np.where((ids >= 0)[..., None], tracks.landmark_positions[where], np.nan)
        probabilities = calibration.probability(distances)
        candidates = Candidates(frame.keypoints, ids, positions, probabilities)
        begin = time.perf_counter()
        result = solve_pose(candidates, frame.camera, MIN_PROBABILITY, "known", of_map=True)
        pose_seconds.append(time.perf_counter() - begin)
        found.append(result)
        errors.append(
            (np.inf, np.inf)
            if result.cam_from_world is None
            else pose_error(result.cam_from_world, frame.cam_from_world)
        )
    off = np.array(errors)
    return HalvesResult(
        size,
        len(support.ids),
        len(off),
        [float(((off[:, 0] <= d) & (off[:, 1] <= a)).mean()) for d, a in THRESHOLDS],
        (float(np.median(off[:, 0])), float(np.median(off[:, 1]))),
        float(np.median([f.inliers for f in found])),
        1000 * float(np.median(seconds)),
        1000 * float(np.median(pose_seconds)),
    )


def main() -> None:
    """Prints the table of docs/results/localization.md."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tracks", type=Path)
    parser.add_argument("--calibrate", type=Path, nargs="+", required=True, help="tracks files")
    parser.add_argument("--encoder", help="default: the encoder of the tracks' descriptor")
    parser.add_argument("--dims", default="16,32,64", help="code lengths; default: 16,32,64")
    parser.add_argument(
        "--stride", type=int, default=1, help="localize every n-th frame; default: 1"
    )
    args = parser.parse_args()
    tracks = Tracks.load(args.tracks)
    others = [Tracks.load(path) for path in args.calibrate]
    encoder = pm.Encoder.load(args.encoder or tracks.descriptor)
    kinds = kinds_of_map(encoder, [int(dim) for dim in args.dims.split(",")])
    rows, found = [], {}
    with progress_bar() as progress:
        for name, build in tracked(kinds.items(), progress, "localize", len(kinds)):
            fitted = calibrated(build, others)
            found[name] = localize_halves(tracks, build, fitted, stride=args.stride)
    for name, r in found.items():
        rows.append(
            [
                name,
                f"{r.bytes_per_landmark:.0f}",
                *(f"{share:.3f}" for share in r.recall),
                "{:.4f}, {:.3f}°".format(*r.median_error),
                f"{r.median_inliers:.0f}",
                f"{r.search_ms:.0f} ms",
                f"{r.pose_ms:.0f} ms",
            ]
        )
    heads = ["map", "bytes per landmark", *(f"recall at {d:g}, {a:g}°" for d, a in THRESHOLDS)]
    print(ReportTable([*heads, "median error", "inliers", "search", "pose"], rows).markdown())


if __name__ == "__main__":
    main()
