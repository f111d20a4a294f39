"""How often a wrong pose is believed: frames localized in maps of their own and of other places.

python benchmarks/localization_confidence.py TRACKS... [--fit NAME,...] [--stride 1] [--json FILE]

Builds the map of every tracks file as `protomark build` does and localizes the keyframes of all
*other* sequences in it: whatever pose comes out is wrong. Frames of the same sequence are
localized in maps of the other nine tenths of their keyframes and of the earlier half: such a pose
is right if it is off by at most 5 % of the median depth of its landmarks and 5 degrees.

With --fit, the weights of `protomark.localization.confidence` are fitted to the frames and maps of
the named sequences and printed. The table always uses the weights in the package.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.build import build_map
from protomark.console import track
from protomark.evaluation.pose import Frame
from protomark.evaluation.protocol import split
from protomark.localization import Localization, Localizer
from protomark.localization.absolute_pose import pose_error
from protomark.localization.confidence import Evidence, confidence
from protomark.logistic import fit
from protomark.tracks.file import Tracks, sequence_name
from protomark.upright import SUFFIX, upright_tracks

DEPTH_SHARE, DEGREES = 0.05, 5.0
LEVELS = (0.5, 0.9, 0.99)


@dataclass(frozen=True)
class Case:
    """One frame in one map.

    Attributes:
        scene: sequence of the map.
        frames: sequence of the frame.
        kind: "other", "tenth" or "half".
        right: whether the pose is right.
        evidence: what spoke for it.
    """

    scene: str
    frames: str
    kind: str
    right: bool
    evidence: Evidence


def own_maps(tracks: Tracks) -> Iterator[tuple[str, NDArray[np.int64], NDArray[np.int64]]]:
    """Kinds of maps of a part of a sequence: rows that build it, and keyframes to localize."""
    part = split(tracks, 0)
    yield "tenth", part.support_rows, part.query_keyframes
    keyframes = len(tracks.keyframe_names)
    rows = tracks.observations
    rows = rows[tracks.keyframe_of_keypoint[rows] < keyframes // 2]
    yield "half", rows, np.arange(keyframes // 2, keyframes)


def is_right(found: Localization, frame: Frame, positions: NDArray[np.float64]) -> bool:
    """Whether a pose is near the true one, for landmarks at these positions."""
    if found.cam_from_world is None or not len(positions):
        return False
    true = frame.cam_from_world
    depth = float(np.median(positions @ true[2, :3] + true[2, 3]))
    distance, degrees = pose_error(found.cam_from_world, true)
    return depth > 0 and distance <= DEPTH_SHARE * depth and degrees <= DEGREES


def localize(localizer: Localizer, frame: Frame) -> Localization:
    """One keyframe of some tracks."""
    return localizer.localize_features(frame.keypoints, frame.descriptors, frame.camera)


def collect(loaded: dict[str, Tracks], encoder: pm.Encoder, dim: int, stride: int) -> list[Case]:
    """Every frame in every map."""
    cases = []
    for name, tracks in track(loaded.items(), f"maps of {dim} numbers", len(loaded)):
        for kind, rows, asked in own_maps(tracks):
            kept = np.zeros(len(tracks.keypoints), bool)
            kept[rows] = True
            localizer = Localizer(build_map(tracks.where(kept), encoder, dim))
            for keyframe in asked[::stride]:
                frame = Frame.of(tracks, int(keyframe))
                found = localize(localizer, frame)
                positions = localizer.scene.positions(found.landmarks)
                right = is_right(found, frame, positions)
                cases.append(Case(name, name, kind, right, found.evidence))
        localizer = Localizer(build_map(tracks, encoder, dim))
        for other, theirs in loaded.items():
            if other == name:
                continue
            for keyframe in range(0, len(theirs.keyframe_names), stride):
                found = localize(localizer, Frame.of(theirs, keyframe))
                cases.append(Case(name, other, "other", False, found.evidence))
    return cases


def fit_weights(cases: list[Case]) -> NDArray[np.float64]:
    """Weights that fit poses, each (map, kind) counting alike."""
    posed = [c for c in cases if c.evidence.inliers]
    groups = [(c.scene, c.kind) for c in posed]
    weights = np.array([1 / groups.count(g) for g in groups])
    features = np.array([c.evidence.features() for c in posed])
    return fit(features, np.array([c.right for c in posed]), weights)


def rows(cases: list[Case]) -> list[dict[str, Any]]:
    """Figures by map and kind: frames, right poses, and what is believed at each level."""
    table = []
    for scene, kind in dict.fromkeys((c.scene, c.kind) for c in cases):
        mine = [c for c in cases if (c.scene, c.kind) == (scene, kind)]
        table.append({"map": scene, **_row(mine, kind)})
    for kind in dict.fromkeys(c.kind for c in cases):
        table.append({"map": "all", **_row([c for c in cases if c.kind == kind], kind)})
    return table


def _row(mine: list[Case], kind: str) -> dict[str, Any]:
    right = np.array([c.right for c in mine])
    sure = np.array([confidence(c.evidence) if c.evidence.inliers else 0.0 for c in mine])
    return {
        "kind": kind,
        "frames": len(mine),
        "right": int(right.sum()),
        "mean_confidence": float(sure.mean()),
        "believed_right": {str(x): int((right & (sure >= x)).sum()) for x in LEVELS},
        "believed_wrong": {str(x): int((~right & (sure >= x)).sum()) for x in LEVELS},
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tracks", type=Path, nargs="+")
    parser.add_argument("--encoder", help="by default the one of the tracks' descriptor")
    parser.add_argument("--dims", default="32", help="lengths of codes, for example 16,32")
    parser.add_argument("--stride", type=int, default=1, help="every so many frames")
    parser.add_argument("--fit", default="", help="sequences to fit weights to")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    loaded = {sequence_name(path): Tracks.load(path) for path in asked.tracks}
    encoder = pm.Encoder.load(asked.encoder or next(iter(loaded.values())).descriptor)
    if encoder.descriptor.endswith(SUFFIX):
        loaded = {name: upright_tracks(tracks) for name, tracks in loaded.items()}
    dims = [int(dim) for dim in asked.dims.split(",")]
    cases = [case for dim in dims for case in collect(loaded, encoder, dim, asked.stride)]
    table = rows(cases)
    for row in table:
        print(
            f"{row['map']:10} {row['kind']:6} {row['frames']:6} frames, {row['right']:5} right; "
            f"believed right {row['believed_right']}, wrong {row['believed_wrong']}"
        )
    facts: dict[str, Any] = {"encoder": encoder.name, "dims": dims, "rows": table}
    if asked.fit:
        names = asked.fit.split(",")
        weights = fit_weights([c for c in cases if c.scene in names and c.frames in names])
        facts["weights"] = [float(f"{w:.4g}") for w in weights]
        print("weights fitted to", asked.fit, facts["weights"])
    if asked.json:
        asked.json.write_text(json.dumps(facts, indent=1) + "\n")


if __name__ == "__main__":
    main()
