"""Measures how often a wrong pose is believed: other places, wrong cameras, wrong pixels.

python benchmarks/scripts/localization_confidence.py TRACKS... [--fit NAME,...] [--stride 1]

The script builds the map of every tracks file as `protomark build` does and localizes the keyframes
of all *other* sequences in it: every pose found there is wrong. It localizes frames of the same
sequence in a map of the other nine tenths of the keyframes and in a map of the earlier half, with
the right camera and with wrong ones (`situations`): such a pose is right if its errors are at most
5 % of the median depth of its landmarks and 5 degrees. A right camera is judged twice, as the map's
and as the user's. Prints the tables of docs/results/localization.md.

With --fit, the script fits the weights of `protomark.localization.confidence` to the frames and
maps of the named sequences, prints them, and the tables use them.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.cli.terminal import progress_bar
from protomark.evaluation.frames import QueryFrame
from protomark.evaluation.protocol import split
from protomark.geometry.absolute_pose import FocalLength
from protomark.geometry.camera import Camera
from protomark.geometry.pose import pose_error
from protomark.localization import Localization, Localizer
from protomark.localization import confidence as confidences
from protomark.localization.confidence import (
    DEGREES,
    DEPTH_SHARE,
    CameraOrigin,
    Evidence,
    confidence,
)
from protomark.maps.build import build_map, tracks_for
from protomark.match_calibration import fit_logistic, sigmoid
from protomark.progress import Progress, tracked
from protomark.tracks.file import Tracks, sequence_name
from protomark_bench.report import ReportTable

FOCAL_SCALES = (0.5, 0.8, 1.25, 2.0)
SHIFTS = (0.1, 0.25)  # of the principal point, as a share of the image
# How much a wrong pose counts beside a right one if the map was made with the camera: then only
# wrong pixels can be the cause, and right poses must stay believed.
WRONG_OF_MAP = 0.1
BELIEVED = 0.9


@dataclass(frozen=True)
class Situation:
    """What localizing is given for a frame.

    Attributes:
        name: what is wrong, "right" for nothing.
        frame: the frame, with this camera and these keypoints.
        focal_length: see `Localizer.localize`.
    """

    name: str
    frame: QueryFrame
    focal_length: FocalLength = "known"


@dataclass(frozen=True)
class ConfidenceSample:
    """One frame in one map.

    Attributes:
        scene: sequence of the map.
        frames: sequence of the frame.
        situation: of `situations`, or "other place".
        right: whether the pose is right.
        evidence: what the confidence is computed from.
    """

    scene: str
    frames: str
    situation: str
    right: bool
    evidence: Evidence


def situations(frame: QueryFrame, rng: np.random.Generator) -> Iterator[Situation]:
    """Yields a frame as it is, and with what users get wrong."""
    camera, keypoints = frame.camera, frame.keypoints
    size = np.array([camera.width, camera.height])
    yield Situation("right", frame)
    for scale in FOCAL_SCALES:
        wrong = changed(camera, scale, np.zeros(2))
        yield Situation(f"focal length x {scale:g}", replace(frame, camera=wrong))
    for share in SHIFTS:
        turn = rng.uniform(0, 2 * np.pi)
        wrong = changed(camera, 1.0, share * size * (np.cos(turn), np.sin(turn)))
        yield Situation(f"principal point off by {share:.0%}", replace(frame, camera=wrong))
    guess = Camera.guess(camera.width, camera.height)
    yield Situation("estimated focal length", replace(frame, camera=guess), "unknown")
    rough = changed(camera, rng.uniform(0.8, 1.25), np.zeros(2))
    yield Situation("rough focal length", replace(frame, camera=rough), "rough")
    # With others, keypoints outside the image would be refused.
    inside = (keypoints[:, ::-1] < size).all(1)
    swapped = replace(
        frame, keypoints=keypoints[inside, ::-1], descriptors=frame.descriptors[inside]
    )
    yield Situation("(row, column)", swapped)


def changed(camera: Camera, scale: float, shift: NDArray[np.float64]) -> Camera:
    """A camera with its focal length scaled and its principal point shifted by pixels (2,)."""
    params = np.array(camera.params)
    params[camera.colmap.focal_length_idxs()] *= scale
    params[camera.colmap.principal_point_idxs()] += shift
    return replace(camera, params=tuple(params.tolist()))


def partial_maps(tracks: Tracks) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Yields rows of the observations that build a map, and keyframes to localize in it."""
    part = split(tracks, 0)
    yield part.support_rows, part.query_keyframes
    half = len(tracks.keyframe_names) // 2
    rows = tracks.observations
    rows = rows[tracks.keyframe_of_keypoint[rows] < half]
    yield rows, np.arange(half, len(tracks.keyframe_names))


def is_right(found: Localization, frame: QueryFrame, positions: NDArray[np.float64]) -> bool:
    """Whether a pose is near the true one, relative to the depth of these positions."""
    if found.cam_from_world is None or not len(positions):
        return False
    true = frame.cam_from_world
    depth = float(np.median(positions @ true[2, :3] + true[2, 3]))
    distance, degrees = pose_error(found.cam_from_world, true)
    return depth > 0 and distance <= DEPTH_SHARE * depth and degrees <= DEGREES


def localize(localizer: Localizer, given: Situation) -> Localization | None:
    """The pose of a frame; None if what is given is refused."""
    frame = given.frame
    try:
        return localizer.localize_features(
            frame.keypoints, frame.descriptors, frame.camera, focal_length=given.focal_length
        )
    except ValueError:
        return None


def collect(
    loaded: dict[str, Tracks], encoder: pm.Encoder, dim: int, stride: int, progress: Progress
) -> list[ConfidenceSample]:
    """Localizes frames in every map."""
    found: list[ConfidenceSample] = []
    rng = np.random.default_rng(0)

    def add(scene: str, frames: str, situation: str, right: bool, evidence: Evidence) -> None:
        origins: list[CameraOrigin] = ["map", "user"]
        if evidence.origin == "estimate":
            origins = ["estimate"]
        if situation.startswith(("focal", "principal")):
            origins = ["user"]
        for origin in origins:
            judged = replace(evidence, origin=origin)
            found.append(ConfidenceSample(scene, frames, situation, right, judged))

    for name, tracks in tracked(loaded.items(), progress, f"maps of {dim} numbers", len(loaded)):
        for rows, queries in partial_maps(tracks):
            used = np.zeros(len(tracks.keypoints), bool)
            used[rows] = True
            localizer = Localizer(build_map(tracks.where(used), encoder, dim))
            for keyframe in queries[::stride]:
                for given in situations(QueryFrame.of(tracks, int(keyframe)), rng):
                    pose = localize(localizer, given)
                    if pose is not None:
                        positions = localizer.scene.positions(pose.landmarks)
                        right = is_right(pose, given.frame, positions)
                        add(name, name, given.name, right, pose.evidence)
        localizer = Localizer(build_map(tracks, encoder, dim))
        for other, theirs in loaded.items():
            for keyframe in range(0, len(theirs.keyframe_names) if other != name else 0, stride):
                frame = QueryFrame.of(theirs, keyframe)
                # Every second frame has its focal length estimated.
                known = keyframe // stride % 2 == 0
                guess = Camera.guess(frame.camera.width, frame.camera.height)
                given = Situation("other place", frame)
                if not known:
                    given = Situation("other place", replace(frame, camera=guess), "unknown")
                pose = localize(localizer, given)
                if pose is not None:
                    add(name, other, given.name, False, pose.evidence)
    return found


def fit(found: list[ConfidenceSample]) -> None:
    """Fits the weights to all poses found, every scene alike, and puts them in the package."""
    posed = [f for f in found if f.evidence.inliers]
    plain = [f for f in posed if f.situation in ("right", "other place")]
    plain = [f for f in plain if f.evidence.origin == "map"]
    groups = Counter((f.scene, f.situation) for f in plain)
    weights = np.array([1 / groups[f.scene, f.situation] for f in plain])
    features = np.array([f.evidence.place() for f in plain])
    place = fit_logistic(features, np.array([f.right for f in plain]), weights)
    confidences.PLACE_WEIGHTS = rounded(place)
    for origin in confidences.LENS_WEIGHTS:
        wrong = WRONG_OF_MAP if origin == "map" else 1.0
        # The lens decides only where the place is right; a wrong camera that does no harm is
        # neither right nor wrong.
        chosen = [
            f
            for f in posed
            if f.evidence.origin == origin
            and sigmoid(place[0] + f.evidence.place() @ place[1:]) >= 0.5
            and not (f.right and f.situation.startswith(("focal", "principal")))
        ]
        scenes = Counter(f.scene for f in chosen)
        weights = np.array([(1 if f.right else wrong) / scenes[f.scene] ** 0.5 for f in chosen])
        features = np.array([f.evidence.lens() for f in chosen])
        fitted = fit_logistic(features, np.array([f.right for f in chosen]), weights)
        confidences.LENS_WEIGHTS[origin] = rounded(fitted)
    print("PLACE_WEIGHTS =", confidences.PLACE_WEIGHTS)
    print("LENS_WEIGHTS =", confidences.LENS_WEIGHTS)


def rounded(weights: NDArray[np.float64]) -> tuple[float, ...]:
    """The weights with four digits."""
    return tuple(float(f"{w:.4g}") for w in weights)


def table(found: list[ConfidenceSample]) -> ReportTable:
    """Poses of each situation, and how many right and wrong ones are believed."""
    kinds: dict[str, list[ConfidenceSample]] = {}
    for sample in found:
        name = sample.situation
        if name == "right":
            whose = {"map": "the map's camera", "user": "another right camera"}
            name = whose[sample.evidence.origin]
        kinds.setdefault(name, []).append(sample)
    kinds["all"] = found
    rows = []
    for name, chosen in kinds.items():
        right = np.array([f.right for f in chosen])
        believed = np.array(
            [f.evidence.inliers > 0 and confidence(f.evidence) >= BELIEVED for f in chosen]
        )
        counts = (len(chosen), right.sum(), (right & believed).sum(), (~right & believed).sum())
        wrong = Counter(f.scene for f, b in zip(chosen, believed, strict=True) if b and not f.right)
        where = ", ".join(f"{scene} {count}" for scene, count in wrong.most_common())
        rows.append([name, *map(str, counts), where])
    heads = ["situation", "frames", "right", "right, believed at 0.9", "wrong, believed at 0.9"]
    return ReportTable([*heads, "these in maps of"], rows, words=1)


def main() -> None:
    """Measures and prints the tables."""
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
    found = []
    with progress_bar() as progress:
        for dim in map(int, args.dims.split(",")):
            found += collect(loaded, encoder, dim, args.stride, progress)
    names = args.fit.split(",")
    fitted = [f for f in found if f.scene in names and f.frames in names]
    if args.fit:
        fit(fitted)
        print(table(fitted).markdown())
    print(table([f for f in found if f.scene not in names]).markdown())


if __name__ == "__main__":
    main()
