"""From the nearest landmarks of a frame's keypoints to its pose."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from protomark.localization.absolute_pose import (
    AbsolutePose,
    FocalLength,
    estimate,
    project,
    refine,
)
from protomark.localization.confidence import Evidence, confidence
from protomark.matching import MIN_PROBABILITY, accept
from protomark.tracks.file import Camera

# Reprojection error of an inlier, as a share of the image's longer side.
TOLERANCE = 0.005
# So many nearest landmarks of a keypoint are tried once there is a pose.
CANDIDATES = 3
MIN_MATCHES = 4
_NOTHING = Evidence(0, 0, 0)


@dataclass(frozen=True)
class Localization:
    """What came of localizing one frame.

    Attributes:
        camera: the frame's camera, with another focal length where that was estimated.
        cam_from_world: (3, 4) float64, or None where no pose was found.
        keypoints: (i,) int64, rows of the keypoints that agree with the pose.
        pixels: (i, 2) float64, where they are in the image.
        landmarks: (i,) int64, which landmarks they see.
        evidence: what speaks for the pose.
        confidence: probability that the pose is right, 0 without one.
        reason: why there is no pose, else "".
        seconds: what each stage took: features, encode, search, pose, and total.
    """

    camera: Camera
    cam_from_world: NDArray[np.float64] | None = None
    keypoints: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    pixels: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    landmarks: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    evidence: Evidence = _NOTHING
    confidence: float = 0.0
    reason: str = ""
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def inliers(self) -> int:
        """Number of keypoints that agree with the pose."""
        return len(self.keypoints)


def solve(
    keypoints: NDArray[np.float64],
    camera: Camera,
    ids: NDArray[np.int64],
    positions: NDArray[np.float64],
    probabilities: NDArray[np.float64],
    min_probability: float = MIN_PROBABILITY,
    focal_length: FocalLength = "known",
    seconds: Mapping[str, float] | None = None,
) -> Localization:
    """RANSAC over the likely matches; then keypoints may see any of their nearest landmarks.

    Args:
        keypoints: (n, 2) float64, pixels.
        camera: the frame's camera.
        ids: (n, c) int64, the nearest landmarks of each keypoint, -1 where there is none.
        positions: (n, c, 3) float64, theirs, NaN where there is none.
        probabilities: (n,) float64, that the nearest landmark is the right one.
        min_probability: of a match that RANSAC gets.
        focal_length: what is known of the camera's focal length.
        seconds: what earlier stages took, by name.
    """
    began = time.perf_counter()
    result = _solve(keypoints, camera, ids, positions, probabilities, min_probability, focal_length)
    stages = {**(seconds or {}), "pose": time.perf_counter() - began}
    return replace(result, seconds={**stages, "total": sum(stages.values())})


def _solve(
    keypoints: NDArray[np.float64],
    camera: Camera,
    ids: NDArray[np.int64],
    positions: NDArray[np.float64],
    probabilities: NDArray[np.float64],
    min_probability: float,
    focal_length: FocalLength,
) -> Localization:
    placed = np.isfinite(positions).all(axis=2)
    ids = np.where(placed, ids, -1)
    if len(keypoints) < MIN_MATCHES:
        return Localization(camera, reason=f"{len(keypoints)} keypoints: blurred, dark or empty")
    matches = accept(ids[:, 0], probabilities, min_probability)
    evidence = Evidence(0, len(matches), 0)
    if len(matches) < MIN_MATCHES:
        reason = f"{len(matches)} likely matches of {len(keypoints)} keypoints: another place?"
        return Localization(camera, evidence=evidence, reason=reason)
    tolerance = TOLERANCE * max(camera.width, camera.height)
    found = estimate(
        keypoints[matches.keypoints],
        positions[matches.keypoints, 0],
        camera,
        tolerance,
        focal_length,
    )
    if found is None:
        reason = f"no pose agrees with {MIN_MATCHES} of {len(matches)} likely matches"
        return Localization(camera, evidence=evidence, reason=reason)
    agreeing = matches.keypoints[found.inliers]
    evidence = Evidence.of(found.camera, keypoints[agreeing], len(matches))
    pose, rows, columns = _complete(found, keypoints, ids, positions, tolerance)
    return Localization(
        found.camera,
        pose,
        rows,
        keypoints[rows],
        ids[rows, columns],
        evidence,
        confidence(evidence),
    )


def _complete(
    found: AbsolutePose,
    keypoints: NDArray[np.float64],
    ids: NDArray[np.int64],
    positions: NDArray[np.float64],
    tolerance: float,
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """The pose refined on all keypoints one of whose nearest landmarks projects to them.

    Returns:
        The pose, and the inliers: rows of keypoints and columns of their landmarks.
    """
    pose = found.cam_from_world
    rows, columns = _agreeing(pose, found, keypoints, ids, positions, tolerance)
    if len(rows) >= MIN_MATCHES:
        pose = refine(pose, keypoints[rows], positions[rows, columns], found.camera, tolerance)
        rows, columns = _agreeing(pose, found, keypoints, ids, positions, tolerance)
    return pose, rows, columns


def _agreeing(
    pose: NDArray[np.float64],
    found: AbsolutePose,
    keypoints: NDArray[np.float64],
    ids: NDArray[np.int64],
    positions: NDArray[np.float64],
    tolerance: float,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of the candidates within the tolerance; a landmark and a keypoint once."""
    shape = ids.shape
    there = ids >= 0
    pixels = np.full((*shape, 2), np.inf)
    pixels[there] = project(found.camera, pose, positions[there])
    error = np.linalg.norm(pixels - keypoints[:, None], axis=2)
    inside = error <= tolerance
    rows = np.flatnonzero(inside.any(axis=1))
    columns = inside[rows].argmax(axis=1)
    # Of the keypoints that see one landmark the nearest to its projection keeps it.
    order = np.lexsort((error[rows, columns], ids[rows, columns]))
    _, first = np.unique(ids[rows, columns][order], return_index=True)
    kept = np.sort(order[first])
    return rows[kept], columns[kept]
