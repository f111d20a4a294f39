"""The later part of a sequence localized in a map of its earlier part, by several kinds of map."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.acceptance import Acceptance
from protomark.calibration import Search, answers, fit_acceptance, held_out
from protomark.evaluation import pose
from protomark.evaluation.methods.medoid import medoid
from protomark.evaluation.support import Support
from protomark.localization.absolute_pose import pose_error
from protomark.localization.results import THRESHOLDS
from protomark.localization.solve import CANDIDATES, Localization, solve
from protomark.tracks.file import Tracks

MIN_OBSERVATIONS = 2


@dataclass(frozen=True)
class Variant:
    """A kind of map.

    Attributes:
        name: what tables say.
        build: makes a search for the `CANDIDATES` nearest landmarks of observations, and the bytes
            a landmark takes in it, its position left out.
    """

    name: str
    build: Callable[[Support], tuple[Search, float]]


def traditional() -> Variant:
    """All descriptors of every landmark, searched by Hamming distance."""

    def build(support: Support) -> tuple[Search, float]:
        size = len(support.descriptors) / len(support.ids) * support.descriptors.shape[1] + 1
        return _hamming(support.descriptors, support.landmarks), size

    return Variant("all descriptors", build)


def medoids() -> Variant:
    """One descriptor a landmark, the one nearest to its others."""

    def build(support: Support) -> tuple[Search, float]:
        chosen = medoid(support)
        return _hamming(chosen.descriptors, chosen.landmarks), chosen.bytes_per_landmark

    return Variant("medoid", build)


def prototypes(encoder: pm.Encoder, dim: int) -> Variant:
    """A prototype of `dim` numbers a landmark, each of 8 bits."""

    def build(support: Support) -> tuple[Search, float]:
        scene = pm.PrototypeMap(encoder, dim)
        scene.add(support.landmarks, support.descriptors)
        return lambda d: scene.search(d, k=CANDIDATES), dim + 1

    return Variant(f"prototypes, {dim}", build)


def _hamming(descriptors: NDArray[np.uint8], landmarks: NDArray[np.int64]) -> Search:
    descriptors = np.ascontiguousarray(descriptors)

    def search(queries: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        ids, bits = pm.hamming_search(queries, descriptors, k=CANDIDATES, landmarks=landmarks)
        return ids, np.where(ids >= 0, bits**2, bits)  # squared, as a map's distances are

    return search


@dataclass(frozen=True)
class HalvesResult:
    """One kind of map on one sequence.

    Attributes:
        variant: its name.
        bytes_per_landmark: all that matching needs, the position left out.
        landmarks: of the map.
        frames: asked for.
        recall: share of the frames whose pose is within each of `THRESHOLDS`.
        median_error: of all frames; distance in world units and degrees, infinite without a pose.
        median_inliers: of all frames.
        search_ms, pose_ms: median time of a frame on one thread; the search of prototypes encodes,
            too.
    """

    variant: str
    bytes_per_landmark: float
    landmarks: int
    frames: int
    recall: list[float]
    median_error: tuple[float, float]
    median_inliers: float
    search_ms: float
    pose_ms: float

    def as_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return asdict(self)


def calibrated(variant: Variant, sequences: Sequence[Tracks], frames: int = 40) -> Acceptance:
    """What this kind of map accepts, fitted to frames of some sequences."""
    given = []
    for tracks in sequences:
        rows, asked = held_out(tracks, frames)
        support = Support(tracks.landmark_of_keypoint[rows], tracks.descriptors[rows])
        given.append(answers(tracks, asked, variant.build(support)[0]))
    return fit_acceptance(given)


def localize_halves(
    tracks: Tracks,
    variant: Variant,
    acceptance: Acceptance,
    share: float = 0.5,
    stride: int = 1,
) -> tuple[HalvesResult, list[Localization]]:
    """Localize the frames after the first `share` of a sequence in a map of those before.

    The map holds landmarks with two observations before; no later observation is in a prototype.
    Positions are those of the tracks, triangulated from all keyframes, for all variants alike.

    Args:
        tracks: a sequence, its keyframes in order of time.
        variant: the kind of map.
        acceptance: what it accepts.
        share: of the keyframes that build the map.
        stride: every so many of the others is asked for.
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
    search, size = variant.build(support)
    found, errors, seconds = [], [], []
    for keyframe in range(cut, keyframes, stride):
        frame = pose.Frame.of(tracks, keyframe)
        began = time.perf_counter()
        ids, distances = search(frame.descriptors)
        seconds.append(time.perf_counter() - began)
        where = np.searchsorted(tracks.landmark_ids, np.maximum(ids, tracks.landmark_ids[0]))
        positions = np.where((ids >= 0)[..., None], tracks.landmark_positions[where], np.nan)
        probabilities = acceptance.probability(distances)
        result = solve(frame.keypoints, frame.camera, ids, positions, probabilities)
        found.append(result)
        errors.append(
            (np.inf, np.inf)
            if result.cam_from_world is None
            else pose_error(result.cam_from_world, frame.cam_from_world)
        )
    off = np.array(errors)
    return (
        HalvesResult(
            variant.name,
            size,
            len(support.ids),
            len(off),
            [float(((off[:, 0] <= d) & (off[:, 1] <= a)).mean()) for d, a in THRESHOLDS],
            (float(np.median(off[:, 0])), float(np.median(off[:, 1]))),
            float(np.median([f.inliers for f in found])),
            1000 * float(np.median(seconds)),
            1000 * float(np.median([f.seconds["pose"] for f in found])),
        ),
        found,
    )
