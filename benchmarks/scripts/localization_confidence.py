"""Measures how often a wrong pose gets a high confidence, in maps of the same and other scenes.

python benchmarks/scripts/localization_confidence.py TRACKS... [--fit NAME,...] [--stride 1]

The script builds the map of every tracks file as `protomark build` does and localizes the keyframes
of all *other* sequences in it: every pose found there is wrong. It localizes frames of the same
sequence in a map of the other nine tenths of the keyframes and in a map of the earlier half: such a
pose is right if its errors are at most 5 % of the median depth of its landmarks and 5 degrees.
Prints the table of docs/results/localization.md.

With --fit, the script fits the weights of `protomark.localization.confidence` to the frames and
maps of the named sequences and prints them. The table always uses the weights in the package.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.cli.terminal import progress_bar
from protomark.evaluation.frames import QueryFrame
from protomark.evaluation.protocol import split
from protomark.geometry.pose import pose_error
from protomark.localization import Localization, Localizer
from protomark.localization.confidence import Evidence, confidence
from protomark.maps.build import build_map, tracks_for
from protomark.match_calibration import fit_logistic
from protomark.progress import Progress, tracked
from protomark.tracks.file import Tracks, sequence_name
from protomark_bench.report import ReportTable

DEPTH_SHARE, DEGREES = 0.05, 5.0
LEVELS = (0.5, 0.9, 0.99)
KINDS = ("other", "tenth", "half")


@dataclass(frozen=True)
class ConfidenceSample:
    """One frame in one map.

    Attributes:
        scene: sequence of the map.
        frames: sequence of the frame.
        kind: of `KINDS`.
        right: whether the pose is right.
        evidence: what the confidence is computed from.
    """

    scene: str
    frames: str
    kind: str
    right: bool
    evidence: Evidence


def partial_maps(tracks: Tracks) -> Iterator[tuple[str, NDArray[np.int64], NDArray[np.int64]]]:
    """Yields (kind, rows of the observations that build the map, keyframes to localize)."""
    part = split(tracks, 0)
    yield "tenth", part.support_rows, part.query_keyframes
    half = len(tracks.keyframe_names) // 2
    rows = tracks.observations
    rows = rows[tracks.keyframe_of_keypoint[rows] < half]
    yield "half", rows, np.arange(half, len(tracks.keyframe_names))


def is_right(found: Localization, frame: QueryFrame, positions: NDArray[np.float64]) -> bool:
    """Whether a pose is near the true one, relative to the depth of these positions."""
    if found.cam_from_world is None or not len(positions):
        return False
    true = frame.cam_from_world
    depth = float(np.median(positions @ true[2, :3] + true[2, 3]))
    distance, degrees = pose_error(found.cam_from_world, true)
    return depth > 0 and distance <= DEPTH_SHARE * depth and degrees <= DEGREES


def collect(
    loaded: dict[str, Tracks], encoder: pm.Encoder, dim: int, stride: int, progress: Progress
) -> list[ConfidenceSample]:
    """Localizes every frame in every map."""
    found = []
    for name, tracks in tracked(loaded.items(), progress, f"maps of {dim} numbers", len(loaded)):
        for kind, rows, queries in partial_maps(tracks):
            used = np.zeros(len(tracks.keypoints), bool)
            used[rows] = True
            localizer = Localizer(build_map(tracks.where(used), encoder, dim))
            for keyframe in queries[::stride]:
                frame = QueryFrame.of(tracks, int(keyframe))
                pose = localizer.localize_features(frame.keypoints, frame.descriptors, frame.camera)
                right = is_right(pose, frame, localizer.scene.positions(pose.landmarks))
                found.append(ConfidenceSample(name, name, kind, right, pose.evidence))
        localizer = Localizer(build_map(tracks, encoder, dim))
        for other, theirs in loaded.items():
            for keyframe in range(0, len(theirs.keyframe_names) if other != name else 0, stride):
                frame = QueryFrame.of(theirs, keyframe)
                pose = localizer.localize_features(frame.keypoints, frame.descriptors, frame.camera)
                found.append(ConfidenceSample(name, other, "other", False, pose.evidence))
    return found


def fit_weights(found: list[ConfidenceSample]) -> NDArray[np.float64]:
    """Fits the weights to all poses found; every (map, kind) has the same total weight."""
    posed = [f for f in found if f.evidence.inliers]
    groups = [(f.scene, f.kind) for f in posed]
    weights = np.array([1 / groups.count(g) for g in groups])
    features = np.array([f.evidence.features() for f in posed])
    return fit_logistic(features, np.array([f.right for f in posed]), weights)


def table(found: list[ConfidenceSample]) -> ReportTable:
    """Frames, right poses, and how many right and wrong poses reach each confidence level."""
    rows = []
    for scene in [*dict.fromkeys(f.scene for f in found), "all"]:
        for kind in KINDS:
            chosen = [f for f in found if f.kind == kind and scene in (f.scene, "all")]
            right = np.array([f.right for f in chosen], bool)
            sure = np.array([confidence(f.evidence) if f.evidence.inliers else 0.0 for f in chosen])
            reached = [
                "; ".join(str(int((which & (sure >= level)).sum())) for level in LEVELS)
                for which in (right, ~right)
            ]
            rows.append([scene, kind, f"{len(chosen)}", f"{right.sum()}", *reached])
    levels = "; ".join(f"{level:g}" for level in LEVELS)
    heads = ["map of", "frames of", "frames", "right", f"right, believed at {levels}"]
    return ReportTable([*heads, f"wrong, believed at {levels}"], rows, words=2)


def main() -> None:
    """Measures and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tracks", type=Path, nargs="+")
    parser.add_argument("--encoder", help="default: the encoder of the tracks' descriptor")
    parser.add_argument("--dims", default="32", help="code lengths, for example 16,32; default: 32")
    parser.add_argument(
        "--stride", type=int, default=1, help="localize every n-th frame; default: 1"
    )
    parser.add_argument(
        "--fit", default="", help="sequences, separated by commas, to fit the weights to"
    )
    args = parser.parse_args()
    loaded = {sequence_name(path): Tracks.load(path) for path in args.tracks}
    encoder = pm.Encoder.load(args.encoder or next(iter(loaded.values())).descriptor)
    loaded = {name: tracks_for(encoder, tracks) for name, tracks in loaded.items()}
    dims = [int(dim) for dim in args.dims.split(",")]
    found = []
    with progress_bar() as progress:
        for dim in dims:
            found += collect(loaded, encoder, dim, args.stride, progress)
    print(table(found).markdown())
    if args.fit:
        names = args.fit.split(",")
        weights = fit_weights([f for f in found if f.scene in names and f.frames in names])
        print(f"weights fitted to {args.fit}:", [float(f"{w:.4g}") for w in weights])


if __name__ == "__main__":
    main()
