"""Compares two rules that accept matches, calibrated probabilities and fixed ratios, on frames.

python benchmarks/scripts/match_calibration.py TRACKS... [--dim 32]

The script localizes keyframes of the later half of each sequence in a map of the earlier half, and
a random tenth of the keyframes in a map of the other nine tenths. It fits the calibration to the
other sequences. Precision and recall are those of accepted matches over all keypoints; a pose is
found if its errors are at most 1 % of the median scene depth and 2 degrees. It then applies the
same calibration, fitted to int8 prototypes, mean or tuned, to words of two numbers and to several
appearances per landmark. Prints the tables of docs/results/localization.md.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.cli.terminal import progress_bar
from protomark.evaluation.frames import FrameMatches, QueryFrame, right_matches, scene_depth
from protomark.evaluation.methods import APPEARANCE_BITS
from protomark.evaluation.protocol import split
from protomark.geometry.pose import pose_error
from protomark.localization.solve import CANDIDATES, Candidates, solve_pose
from protomark.maps.build import build_map
from protomark.match_calibration import MatchCalibration
from protomark.matching import accept
from protomark.progress import tracked
from protomark.tracks.file import Tracks, sequence_name
from protomark.training.match_calibration import (
    fit_calibration,
    held_out_frames,
    label_matches,
    matches_by_kind,
    measure_calibration,
)
from protomark_bench.report import ReportTable

PROBABILITIES = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7)
RATIOS = (0.7, 0.8, 0.9, 0.95)
PARTS = ("tenth", "half")
KINDS = ("int8", "words", "tuned words", "appearances")
FRAMES = 40
# A rule: squared distances (n, 2) -> the score of each match, and the lowest accepted score.
Rule = Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], float]]


def clearness(distances: NDArray[np.float64]) -> NDArray[np.float64]:
    """One minus the ratio of the two smallest distances, (n,), from their squares, (n, 2)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(distances[:, 1] > 0, 1 - np.sqrt(distances[:, 0] / distances[:, 1]), 0.0)


def rules(calibration: MatchCalibration) -> dict[str, Rule]:
    """Name -> rule."""

    def by_probability(least: float) -> Rule:
        return lambda distances: (calibration.probability(distances), least)

    def by_ratio(limit: float) -> Rule:
        return lambda distances: (clearness(distances), 1 - limit)

    def quarter(distances: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        score = clearness(distances)
        return score, float(np.quantile(score, 0.75))

    found = {f"probability {least}": by_probability(least) for least in PROBABILITIES}
    found |= {f"ratio {limit}": by_ratio(limit) for limit in RATIOS}
    return found | {"clearest quarter": quarter}


def measure(
    tracks: Tracks, encoder: pm.Encoder, dim: int, compared: dict[str, Rule]
) -> NDArray[np.float64]:
    """(part, rule, 4): accepted matches per frame, precision, recall, share of poses found."""
    depth = scene_depth(tracks)
    half = len(tracks.keyframe_names) // 2
    part, rows = split(tracks, 0), tracks.observations
    cuts = {
        "tenth": (part.support_rows, part.query_keyframes),
        "half": (
            rows[tracks.keyframe_of_keypoint[rows] < half],
            np.arange(half, len(tracks.keyframe_names)),
        ),
    }
    result = np.zeros((len(PARTS), len(compared), 4))
    for i, name in enumerate(PARTS):
        support, queries = cuts[name]
        used = np.zeros(len(tracks.keypoints), bool)
        used[support] = True
        scene = build_map(tracks.where(used), encoder, dim)
        sums = np.zeros((len(compared), 5))
        for keyframe in queries[:: max(1, len(queries) // FRAMES)]:
            frame = QueryFrame.of(tracks, int(keyframe))
            ids, distances = scene.search(frame.descriptors, k=CANDIDATES)
            positions = tracks.landmark_positions[np.searchsorted(tracks.landmark_ids, ids)]
            nearest = FrameMatches(np.arange(len(ids)), ids[:, 0])
            right = right_matches(frame, nearest, positions[:, 0])
            for j, score in enumerate(compared.values()):
                values, least = score(distances.astype(np.float64))
                matches = accept(ids[:, 0], values, least)
                candidates = Candidates(frame.keypoints, ids, positions, values)
                found = solve_pose(candidates, frame.camera, least, "known", of_map=True)
                good = False
                if found.cam_from_world is not None:
                    off, angle = pose_error(found.cam_from_world, frame.cam_from_world)
                    good = off <= 0.01 * depth and angle <= 2
                sums[j] += (len(matches), right[matches.keypoints].sum(), right.sum(), good, 1)
        accepted, true, all_right, good_poses, frames = sums.T
        precision, recall = true / np.maximum(accepted, 1), true / np.maximum(all_right, 1)
        result[i] = np.stack([accepted / frames, precision, recall, good_poses / frames], axis=1)
    return result


def kinds(
    tracks: Tracks, encoder: pm.Encoder, dim: int, calibrations: Sequence[MatchCalibration]
) -> NDArray[np.float64]:
    """(kind of map, 3): precision of accepted matches, the expected one, recall."""
    rows, queries = held_out_frames(tracks)
    result = []
    for kind in KINDS:
        scene = pm.PrototypeMap(encoder, dim, APPEARANCE_BITS if kind == "appearances" else 0)
        observed = tracks.landmark_of_keypoint[rows], tracks.descriptors[rows]
        scene.add(*observed)
        with tempfile.TemporaryDirectory() as folder:
            size = dim // 2 + 1 if "words" in kind else None
            by = observed if "tuned" in kind else (None, None)
            sealed = scene.seal(Path(folder) / "scene.pmk", *by, bytes_per_landmark=size)
            given = label_matches(tracks, queries, sealed.search)
        found = measure_calibration("", dim, sealed.tuned, calibrations[sealed.tuned], given)
        result.append([found.precision, found.expected, found.recall])
    return np.array(result)


def main() -> None:
    """Measures all sequences and prints the means."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tracks", type=Path, nargs="+")
    parser.add_argument("--encoder", help="default: the encoder of the tracks' descriptor")
    parser.add_argument("--dim", type=int, default=32, help="code length; default: 32")
    args = parser.parse_args()
    loaded = {sequence_name(path): Tracks.load(path) for path in args.tracks}
    encoder = pm.Encoder.load(args.encoder or next(iter(loaded.values())).descriptor)
    by_rule, by_kind, given = [], [], {}
    with progress_bar() as progress:
        for name, tracks in tracked(loaded.items(), progress, "query maps"):
            given[name] = matches_by_kind(encoder, tracks)
        for name, tracks in tracked(loaded.items(), progress, "localize"):
            others = [m for other, m in given.items() if other != name]
            mean, tuned = (
                fit_calibration([m[args.dim, kind] for m in others]) for kind in (False, True)
            )
            by_rule.append(measure(tracks, encoder, args.dim, rules(mean)))
            by_kind.append(kinds(tracks, encoder, args.dim, (mean, tuned)))
    names = list(rules(MatchCalibration((0.0, 0.0, 0.0))))
    means = np.mean(by_rule, axis=0)
    rows = [
        [
            name,
            *(text for p in means[:, i] for text in (f"{p[0]:.0f}", *(f"{x:.3f}" for x in p[1:]))),
        ]
        for i, name in enumerate(names)
    ]
    heads = [
        f"{part}: {head}" for part in PARTS for head in ("matches", "precision", "recall", "found")
    ]
    print(ReportTable(["accepted", *heads], rows).markdown(), end="\n\n")
    rows = [
        [kind, *(f"{x:.3f}" for x in row)]
        for kind, row in zip(KINDS, np.mean(by_kind, axis=0), strict=True)
    ]
    print(ReportTable(["map", "precision", "expected", "recall"], rows).markdown(), end="\n\n")
    rows = [
        [name, kind, *(f"{x:.3f}" for x in row)]
        for name, table in zip(loaded, by_kind, strict=True)
        for kind, row in zip(KINDS, table, strict=True)
    ]
    heads = ["sequence", "map", "precision", "expected", "recall"]
    print(ReportTable(heads, rows, words=2).markdown())


if __name__ == "__main__":
    main()
