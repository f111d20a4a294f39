"""Where a camera stands, from keypoints and the landmarks that they see."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from protomark.tracks.file import Camera

MAX_ITERATIONS = 2000
MIN_ITERATIONS = 100

# Whether a camera's focal length is right, roughly right and to be refined, or to be estimated.
FocalLength = Literal["known", "rough", "unknown"]

# Camera models that both COLMAP and PoseLib know.
MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "OPENCV_FISHEYE",
)


@dataclass(frozen=True)
class AbsolutePose:
    """A pose and the matches that agree with it.

    Attributes:
        cam_from_world: (3, 4) float64.
        inliers: (n,) bool.
        camera: the camera, with another focal length where that was estimated.
    """

    cam_from_world: NDArray[np.float64]
    inliers: NDArray[np.bool_]
    camera: Camera


def check_camera(camera: Camera) -> None:
    """Raise ValueError unless poses can be found for this camera."""
    if camera.model not in MODELS:
        raise ValueError(
            f"camera model {camera.model} is not one that poses can be found for: undistort the "
            f"images to one of {', '.join(MODELS)}"
        )
    camera.check_params()
    if camera.params[0] <= 0:
        raise ValueError(f"camera {camera.model} {camera.params} has no valid focal length")


def project(
    camera: Camera, cam_from_world: NDArray[np.float64], positions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(n, 3) world positions -> (n, 2) pixels, infinite for what lies behind the camera."""
    import poselib

    check_camera(camera)
    points = positions @ cam_from_world[:, :3].T + cam_from_world[:, 3]
    pixels = np.full((len(points), 2), np.inf)
    front = points[:, 2] > 0
    if front.any():
        model = poselib.Camera(camera.model, list(camera.params), camera.width, camera.height)
        pixels[front] = np.asarray(model.project(points[front, :2] / points[front, 2:]))
    return pixels


def estimate(
    keypoints: NDArray[np.float64],
    positions: NDArray[np.float64],
    camera: Camera,
    tolerance: float,
    focal_length: FocalLength = "known",
) -> AbsolutePose | None:
    """Absolute pose by RANSAC and refinement; None where four matches never agree.

    Known cameras take PoseLib's LO-RANSAC with progressive sampling (Chum and Matas, PROSAC, CVPR
    2005), others COLMAP's, whose refinement moves the focal length, too. Equal matches give equal
    poses.

    Args:
        keypoints: (n, 2) float64, pixels, those of the likeliest matches first.
        positions: (n, 3) float64, the landmark of each, in world coordinates.
        camera: the camera; where its focal length is unknown, only its principal point and the
            image size count.
        tolerance: reprojection error of an inlier, pixels.
        focal_length: what is known of the camera's focal length.

    Raises:
        ValueError: the camera is of no model that poses can be found for.
    """
    check_camera(camera)
    if len(positions) < 4:
        return None
    keypoints = np.ascontiguousarray(keypoints, np.float64)
    if focal_length != "known":
        return _with_focal_length(
            keypoints, positions, camera, tolerance, estimated=focal_length == "unknown"
        )
    import poselib

    # Keypoints and PoseLib share COLMAP's pixels and camera parameters: nothing to shift.
    pose, found = poselib.estimate_absolute_pose(
        keypoints,
        positions,
        camera.as_dict(),
        {
            "max_reproj_error": tolerance,
            "max_iterations": MAX_ITERATIONS,
            "min_iterations": MIN_ITERATIONS,
            "progressive_sampling": True,
            "seed": 0,
        },
        {},
    )
    matrix = np.asarray(pose.Rt, dtype=np.float64)
    if found["num_inliers"] < 4 or not np.isfinite(matrix).all():
        return None
    return AbsolutePose(matrix, np.asarray(found["inliers"], dtype=bool), camera)


def _with_focal_length(
    keypoints: NDArray[np.float64],
    positions: NDArray[np.float64],
    camera: Camera,
    tolerance: float,
    estimated: bool,
) -> AbsolutePose | None:
    from protomark.tracks.colmap import pycolmap, quiet

    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.estimate_focal_length = estimated
    estimation.ransac.max_error = tolerance
    estimation.ransac.max_num_trials = MAX_ITERATIONS
    estimation.ransac.min_num_trials = MIN_ITERATIONS
    estimation.ransac.random_seed = 0
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.refine_focal_length = True
    theirs = pycolmap.Camera(camera.as_dict())
    with quiet():
        found = pycolmap.estimate_and_refine_absolute_pose(
            keypoints, positions, theirs, estimation, refinement
        )
    if found is None:
        return None
    matrix = np.asarray(found["cam_from_world"].matrix(), np.float64)
    inliers = np.asarray(found["inlier_mask"], dtype=bool)
    params = tuple(float(p) for p in theirs.params)
    if not (np.isfinite(matrix).all() and np.isfinite(params).all()) or inliers.sum() < 4:
        return None
    return AbsolutePose(matrix, inliers, replace(camera, params=params))


def refine(
    cam_from_world: NDArray[np.float64],
    keypoints: NDArray[np.float64],
    positions: NDArray[np.float64],
    camera: Camera,
    tolerance: float,
) -> NDArray[np.float64]:
    """The pose (3, 4) that fits these matches best, errors beyond `tolerance` pixels cut off."""
    import poselib

    start = poselib.CameraPose()
    start.R, start.t = cam_from_world[:, :3], cam_from_world[:, 3]
    pose, _ = poselib.refine_absolute_pose(
        np.ascontiguousarray(keypoints, np.float64),
        positions,
        start,
        camera.as_dict(),
        {"loss_type": "TRUNCATED", "loss_scale": tolerance, "max_iterations": 25},
    )
    matrix = np.asarray(pose.Rt, dtype=np.float64)
    return matrix if np.isfinite(matrix).all() else cam_from_world


def centre(cam_from_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 3, 4) poses -> (..., 3) camera centres in the world."""
    rotation, translation = cam_from_world[..., :3], cam_from_world[..., 3]
    return np.asarray(-np.einsum("...ji,...j->...i", rotation, translation))


def pose_error(estimate: NDArray[np.float64], true: NDArray[np.float64]) -> tuple[float, float]:
    """Distance of the camera centres in world units, and angle of the rotation in degrees."""
    distance = np.linalg.norm(centre(estimate) - centre(true))
    # From the distance of the matrices: exact for small angles, where arccos of the trace is not.
    chord = np.linalg.norm(estimate[:, :3] - true[:, :3]) / np.sqrt(8)
    return float(distance), float(np.degrees(2 * np.arcsin(min(chord, 1.0))))
