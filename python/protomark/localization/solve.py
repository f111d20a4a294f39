"""Solves the pose of a frame from the nearest landmarks of its keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.absolute_pose import (
    AbsolutePose,
    FocalLength,
    estimate_pose,
    free_lens,
    pose_covariance,
    refine_pose,
    reprojection_error,
)
from protomark.geometry.camera import Camera
from protomark.geometry.pose import pose_error, transform
from protomark.localization.confidence import (
    DEGREES,
    DEPTH_SHARE,
    CameraOrigin,
    Evidence,
    confidence,
    doubt,
    occupied_cells,
)
from protomark.maps.places import Place
from protomark.matching import accept

# Reprojection error of an inlier, as a share of the image's longer side.
MAX_ERROR = 0.005
# Matches with up to so many times this error tell whether another lens would explain more.
_NEAR = 4
# Number of nearest landmarks per keypoint that are candidates once there is a pose.
CANDIDATES = 3
MIN_MATCHES = 4
_TRIED_PLACES = 2
_NO_EVIDENCE = Evidence(0, 0, 0)


@dataclass(frozen=True)
class Localization:
    """The pose of a frame, and its evidence.

    Attributes:
        camera: the frame's camera, with the estimated focal length if that was not known.
        cam_from_world: (3, 4) float64, None without a pose.
        covariance: (6, 6) float64 of the pose: rotation in radians, then translation, see
            `protomark.geometry.absolute_pose.pose_covariance`; None without a pose, or if its
            inliers leave a direction open.
        place: in which of the places of the map, whose coordinates have nothing to do with each
            other (see `protomark.maps.places`); "" if the map is one place, and without a pose.
        keypoints: (i,) int64, rows of the keypoints that agree with the pose.
        pixels: (i, 2) float64, these keypoints in the image.
        landmarks: (i,) int64, ids of the landmarks that they observe.
        evidence: evidence for the pose.
        confidence: probability that the pose is right, 0 without a pose.
        reason: why there is no pose, or only an unlikely one, else "".
        seconds: seconds of each stage: features, encode, search, pose, and total.
    """

    camera: Camera
    cam_from_world: NDArray[np.float64] | None = None
    keypoints: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    pixels: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    landmarks: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    evidence: Evidence = _NO_EVIDENCE
    confidence: float = 0.0
    reason: str = ""
    seconds: dict[str, float] = field(default_factory=dict)
    covariance: NDArray[np.float64] | None = None
    place: str = ""

    @property
    def inliers(self) -> int:
        """Number of keypoints that agree with the pose."""
        return len(self.keypoints)

    def __repr__(self) -> str:
        """One line, without the arrays."""
        if self.cam_from_world is None:
            return f"<protomark.Localization: no pose, {self.reason}>"
        return (
            f"<protomark.Localization: {self.inliers} inliers of {self.evidence.matches} matches, "
            f"confidence {self.confidence:.3f}>"
        )


@dataclass(frozen=True)
class Candidates:
    """The nearest landmarks of the keypoints of a frame."""

    keypoints: NDArray[np.float64]  # (n, 2) float64, pixels
    # (n, c) int64, ids of the nearest landmarks, -1 where there is none.
    landmarks: NDArray[np.int64]
    positions: NDArray[np.float64]  # (n, c, 3) float64, their positions, NaN where there is none
    # (n,) float64, the probability that the nearest landmark is right.
    probabilities: NDArray[np.float64]


def solve_place(
    candidates: Candidates,
    places: Sequence[Place],
    camera: Camera,
    min_probability: float,
    focal_length: FocalLength,
    of_map: bool,
) -> Localization:
    """Solve the pose in the place that explains most keypoints.

    Args:
        candidates: see `solve_pose`.
        places: places of the map, at least one.
        camera: see `solve_pose`.
        min_probability: see `solve_pose`.
        focal_length: see `solve_pose`.
        of_map: see `solve_pose`.
    """
    nearest = candidates.landmarks[:, 0]
    votes = [candidates.probabilities[place.holds(nearest)].sum() for place in places]
    found = []
    for index in np.argsort(votes)[::-1][:_TRIED_PLACES]:
        inside = places[index].holds(candidates.landmarks)
        here = replace(
            candidates,
            landmarks=np.where(inside, candidates.landmarks, -1),
            positions=np.where(inside[:, :, None], candidates.positions, np.nan),
        )
        one = solve_pose(here, camera, min_probability, focal_length, of_map)
        posed = one.cam_from_world is not None
        found.append(replace(one, place=places[index].name if posed else ""))
    return max(found, key=lambda one: (one.inliers, one.confidence))


def solve_pose(
    candidates: Candidates,
    camera: Camera,
    min_probability: float,
    focal_length: FocalLength,
    of_map: bool,
) -> Localization:
    """Solve the pose by RANSAC over likely matches, and refine it on all nearest landmarks.

    Args:
        candidates: the nearest landmarks of each keypoint.
        camera: the frame's camera.
        min_probability: smallest probability of a match for RANSAC.
        focal_length: see `geometry.absolute_pose.estimate_pose`.
        of_map: whether the map was made with this camera.
    """
    keypoints, positions = candidates.keypoints, candidates.positions
    if len(keypoints) < MIN_MATCHES:
        return Localization(
            camera, reason=f"only {len(keypoints)} keypoints: blurred, dark or empty"
        )
    # Geographic coordinates are large; around their middle nothing is lost by rounding.
    middle = np.nanmedian(positions.reshape(-1, 3), axis=0) if np.isfinite(positions).any() else 0.0
    positions = positions - middle
    landmarks = np.where(np.isfinite(positions).all(axis=2), candidates.landmarks, -1)
    candidates = replace(candidates, positions=positions, landmarks=landmarks)
    matches = accept(landmarks[:, 0], candidates.probabilities, min_probability)
    evidence = Evidence(0, len(matches), 0)
    if len(matches) < MIN_MATCHES:
        reason = f"only {len(matches)} likely matches of {len(keypoints)} keypoints: another place?"
        return Localization(camera, evidence=evidence, reason=reason)
    max_error = MAX_ERROR * max(camera.width, camera.height)
    pixels, nearest = keypoints[matches.keypoints], positions[matches.keypoints, 0]
    found = estimate_pose(pixels, nearest, camera, max_error, focal_length)
    if found is None:
        reason = f"no pose agrees with {MIN_MATCHES} of {len(matches)} likely matches"
        return Localization(camera, evidence=evidence, reason=reason)
    agreeing = matches.keypoints[found.inliers]
    pose, rows, columns = _complete(found, candidates, max_error)
    origin: CameraOrigin = "estimate" if focal_length != "known" else "map" if of_map else "user"
    evidence = Evidence(
        len(agreeing),
        len(matches),
        occupied_cells(found.camera, keypoints[agreeing]),
        origin,
        *_lens_evidence(pose, pixels, nearest, found.camera, max_error),
    )
    cam_from_world = np.column_stack([pose[:, :3], pose[:, 3] - pose[:, :3] @ middle])
    return Localization(
        found.camera,
        cam_from_world,
        rows,
        keypoints[rows],
        landmarks[rows, columns],
        evidence,
        confidence(evidence),
        doubt(evidence),
        covariance=pose_covariance(pose, keypoints[rows], positions[rows, columns], found.camera),
    )


def _lens_evidence(
    pose: NDArray[np.float64],
    pixels: NDArray[np.float64],
    positions: NDArray[np.float64],
    camera: Camera,
    max_error: float,
) -> tuple[float, float, float, float, float]:
    """What `Evidence` has of the lens, from all accepted matches that are roughly right."""
    near = reprojection_error(pose, pixels, positions, camera) <= _NEAR * max_error
    if not near.any():
        return np.inf, 0.0, np.inf, 1.0, np.inf
    free = free_lens(pose, pixels[near], positions[near], camera, max_error)
    depth = float(np.median(np.abs(transform(pose, positions[near])[:, 2])))
    distance, degrees = pose_error(free.cam_from_world, pose)
    shift = max(distance / (DEPTH_SHARE * depth), degrees / DEGREES)
    return shift, free.gain, free.spread / depth, free.stretch, free.deviation


def _complete(
    found: AbsolutePose, candidates: Candidates, max_error: float
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Refine the pose on all keypoints to which one of their nearest landmarks projects.

    Returns:
        The pose, and the rows and columns of the agreeing candidates.
    """
    pose, camera = found.cam_from_world, found.camera
    rows, columns = _agreeing(pose, camera, candidates, max_error)
    if len(rows) >= MIN_MATCHES:
        pixels, positions = candidates.keypoints[rows], candidates.positions[rows, columns]
        pose, _ = refine_pose(pose, pixels, positions, camera, max_error)
        rows, columns = _agreeing(pose, camera, candidates, max_error)
    return pose, rows, columns


def _agreeing(
    pose: NDArray[np.float64], camera: Camera, candidates: Candidates, max_error: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of the candidates within the error, each landmark and keypoint once."""
    landmarks = candidates.landmarks
    present = landmarks >= 0
    pixels = np.full((*landmarks.shape, 2), np.inf)
    pixels[present] = camera.project(transform(pose, candidates.positions[present]))
    error = np.linalg.norm(pixels - candidates.keypoints[:, None], axis=2)
    inside = error <= max_error
    rows = np.flatnonzero(inside.any(axis=1))
    columns = inside[rows].argmax(axis=1)
    # A landmark keeps the keypoint that is nearest to its projection.
    order = np.lexsort((error[rows, columns], landmarks[rows, columns]))
    _, first = np.unique(landmarks[rows, columns][order], return_index=True)
    unique = np.sort(order[first])
    return rows[unique], columns[unique]
