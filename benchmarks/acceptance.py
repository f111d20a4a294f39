"""Which matches to accept: calibrated probabilities beside fixed ratios, on real frames.

python benchmarks/acceptance.py TRACKS... [--dim 32] [--json FILE]

Keyframes of the later half of each sequence are localized in a map of the earlier half, and a
random tenth in a map of the other nine. What is accepted by probability is fitted to the other
sequences. Precision and recall are those of accepted matches over all keypoints; a pose is found if
it is off by at most 1 % of the median scene depth and 2 degrees.

Then the same fit, to maps of 8 bits a number, on maps of 4 bits and of several looks a landmark.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark import calibration
from protomark.acceptance import Acceptance
from protomark.build import build_map
from protomark.calibration import answers, encoder_answers, fit_acceptance, held_out
from protomark.console import track
from protomark.evaluation import pose
from protomark.evaluation.methods import LOOK_BITS
from protomark.evaluation.protocol import split
from protomark.localization.absolute_pose import pose_error
from protomark.localization.solve import CANDIDATES, solve
from protomark.matching import accept
from protomark.tracks.file import Tracks, sequence_name

PROBABILITIES = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7)
RATIOS = (0.7, 0.8, 0.9, 0.95)
FRAMES = 40
# A rule: squared distances (n, 2) -> a score of each match, and the least one that is accepted.
Rule = Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], float]]


def ratio(distances: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) from 0, the two nearest are as far away, to 1."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(distances[:, 1] > 0, 1 - np.sqrt(distances[:, 0] / distances[:, 1]), 0.0)


def rules(acceptance: Acceptance) -> dict[str, Rule]:
    """All that are compared, by name."""

    def by_probability(least: float) -> Rule:
        return lambda distances: (acceptance.probability(distances), least)

    def by_ratio(most: float) -> Rule:
        return lambda distances: (ratio(distances), 1 - most)

    def quarter(distances: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        return ratio(distances), float(np.quantile(ratio(distances), 0.75))

    found = {f"probability {least}": by_probability(least) for least in PROBABILITIES}
    found |= {f"ratio {most}": by_ratio(most) for most in RATIOS}
    return found | {"clearest quarter": quarter}


def parts(tracks: Tracks) -> dict[str, tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Rows that build a map, and keyframes that ask it."""
    part = split(tracks, 0)
    half = len(tracks.keyframe_names) // 2
    rows = tracks.observations
    later = np.arange(half, len(tracks.keyframe_names))
    return {
        "tenth": (part.support_rows, part.query_keyframes),
        "half": (rows[tracks.keyframe_of_keypoint[rows] < half], later),
    }


def measure(tracks: Tracks, encoder: pm.Encoder, dim: int, compared: dict[str, Rule]) -> Any:
    """Part -> rule -> figures."""
    depth = pose.scene_depth(tracks)
    table: dict[str, dict[str, dict[str, float]]] = {}
    for name, (rows, asked) in parts(tracks).items():
        kept = np.zeros(len(tracks.keypoints), bool)
        kept[rows] = True
        scene = build_map(tracks.where(kept), encoder, dim)
        sums = {rule: np.zeros(6) for rule in compared}
        for keyframe in asked[:: max(1, len(asked) // FRAMES)]:
            frame = pose.Frame.of(tracks, int(keyframe))
            ids, distances = scene.search(frame.descriptors, k=CANDIDATES)
            where = np.searchsorted(tracks.landmark_ids, ids)
            positions = tracks.landmark_positions[where]
            every = pose.Matches(np.arange(len(ids)), ids[:, 0])
            right = pose.right(frame, every, positions[:, 0])
            for rule, score in compared.items():
                values, least = score(distances.astype(np.float64))
                taken = accept(ids[:, 0], values, least)
                found = solve(frame.keypoints, frame.camera, ids, positions, values, least)
                off = (np.inf, np.inf)
                if found.cam_from_world is not None:
                    off = pose_error(found.cam_from_world, frame.cam_from_world)
                sums[rule] += (
                    len(taken),
                    right[taken.keypoints].sum(),
                    right.sum(),
                    1,
                    off[0] <= 0.01 * depth and off[1] <= 2,
                    off[0] <= 0.05 * depth and off[1] <= 5,
                )
        table[name] = {
            rule: {
                "accepted": s[0] / s[3],
                "precision": s[1] / max(s[0], 1),
                "recall": s[1] / max(s[2], 1),
                "found": s[4] / s[3],
                "roughly_found": s[5] / s[3],
            }
            for rule, s in sums.items()
        }
    return table


def kinds(tracks: Tracks, encoder: pm.Encoder, dim: int, acceptance: Acceptance) -> Any:
    """Kind of map -> figures of what is accepted in it."""
    rows, asked = held_out(tracks)
    landmarks, descriptors = tracks.landmark_of_keypoint[rows], tracks.descriptors[rows]
    table = {}
    for kind in ("8 bits", "4 bits", "looks"):
        scene = pm.PrototypeMap(encoder, dim, LOOK_BITS if kind == "looks" else 0)
        scene.add(landmarks, descriptors)
        with tempfile.TemporaryDirectory() as folder:
            bits = 4 if kind == "4 bits" else 8
            sealed = scene.seal(Path(folder) / "scene.pmk", bits=bits)
            given = answers(tracks, asked, sealed.search)
        table[kind] = calibration.measure("", dim, acceptance, given).as_dict()
    return table


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tracks", type=Path, nargs="+")
    parser.add_argument("--encoder", help="by default the one of the tracks' descriptor")
    parser.add_argument("--dim", type=int, default=32)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    loaded = {sequence_name(path): Tracks.load(path) for path in asked.tracks}
    encoder = pm.Encoder.load(asked.encoder or next(iter(loaded.values())).descriptor)
    given = {n: encoder_answers(encoder, t)[asked.dim] for n, t in track(loaded.items(), "asking")}
    table, of_kind = {}, {}
    for name, tracks in track(loaded.items(), "localizing"):
        fitted = fit_acceptance([a for other, a in given.items() if other != name])
        table[name] = measure(tracks, encoder, asked.dim, rules(fitted))
        of_kind[name] = kinds(tracks, encoder, asked.dim, fitted)
    for part in ("tenth", "half"):
        print(f"{part}: mean of {', '.join(table)}")
        for rule in rules(Acceptance((0.0, 0.0, 0.0))):
            rows = [found[part][rule] for found in table.values()]
            mean = {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
            spread = " ".join(f"{row['found']:.2f}" for row in rows)
            print(
                f"  {rule:18} accepted {mean['accepted']:6.0f} precision {mean['precision']:.3f} "
                f"recall {mean['recall']:.3f} found {mean['found']:.3f} "
                f"(roughly {mean['roughly_found']:.3f}; {spread})"
            )
    for name, figures in of_kind.items():
        for kind, f in figures.items():
            print(
                f"{name:10} {kind:7} precision {f['precision']:.3f}, expected "
                f"{f['expected']:.3f}, recall {f['recall']:.3f}"
            )
    if asked.json:
        facts = {"dim": asked.dim, "sequences": table, "kinds": of_kind}
        asked.json.write_text(json.dumps(facts, indent=1) + "\n")


if __name__ == "__main__":
    main()
