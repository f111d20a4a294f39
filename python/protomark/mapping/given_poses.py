"""Checks that given poses belong to the images: before the map is made from them."""

from __future__ import annotations

import numpy as np

from protomark.extras import optional
from protomark.geometry.absolute_pose import MAX_ITERATIONS, MIN_ITERATIONS
from protomark.geometry.camera import Camera
from protomark.geometry.pose import relative_pose
from protomark.geometry.triangulation import depth_of_first, epipolar_error
from protomark.mapping.source import FrameSource
from protomark.mapping.survey import Survey

# Two poses fit if the median match is at most so far from its epipolar line, in pixels, and its
# landmark lies before the cameras, where rays meet at an angle (degrees) that tells.
_MAX_ERROR = 4.0
_CLEAR_ANGLE = 0.5
_MIN_FITTING = 0.7
_MIN_MATCHES = 50
# In a pair with a smaller share of matches that agree on a relative pose, they may all be wrong.
_MIN_AGREEING = 0.5


def check_poses_given(source: FrameSource) -> None:
    """Raise ValueError unless the given poses are of the images."""
    poses = source.poses
    if poses is None:
        return
    if len(poses.times) and not source.timed and (poses.times % 1).any():
        raise ValueError(
            f"the poses go by seconds ({poses.example}), but the images' names are no times: name "
            "the images by their times, such as 1305031102.175304.png, or give the poses by name "
            "in an images.txt"
        )
    listing = source.listing()
    found = sum(
        poses.find(name, time if source.timed else None) is not None for name, time in listing
    )
    if found < 2:
        name, time = listing[0]
        first = f"time {time:g}" if source.timed else name
        raise ValueError(
            f"{found} of the {len(listing)} images have one of the {len(poses)} poses: the poses "
            f"start with {poses.example}, the images with {first}; give both the same names or "
            "times"
        )


def check_poses_fit(surveyed: Survey, camera: Camera) -> None:
    """Raise ValueError unless matches lie near the epipolar lines that the given poses draw.

    Only matches count that agree on a relative pose, whatever it is.
    """
    poselib, intrinsics = optional("poselib"), camera.as_dict()
    options = {
        "max_epipolar_error": _MAX_ERROR / 2,
        "min_iterations": MIN_ITERATIONS,
        "max_iterations": MAX_ITERATIONS,
        "seed": 0,
    }
    errors = []
    for pair in surveyed.pairs:
        one, other = (image.pose for image in pair.images)
        if one is None or other is None:
            continue
        _, facts = poselib.estimate_relative_pose(
            pair.first, pair.second, intrinsics, intrinsics, options, {}
        )
        agreeing = np.asarray(facts["inliers"], bool)
        if agreeing.sum() < _MIN_MATCHES or agreeing.mean() < _MIN_AGREEING:
            continue
        rays = camera.rays(pair.first[agreeing]), camera.rays(pair.second[agreeing])
        relative = relative_pose(one, other)
        depth, angle = depth_of_first(*relative, *rays)
        error = epipolar_error(*relative, *rays) * camera.focal_length
        behind = (depth < 0) & (angle > np.radians(_CLEAR_ANGLE))
        errors.append(float(np.median(np.where(behind, np.inf, error))))
    fitting = sum(error <= _MAX_ERROR for error in errors)
    if fitting < _MIN_FITTING * len(errors):
        raise ValueError(
            f"the poses do not fit the images: in {len(errors) - fitting} of {len(errors)} pairs "
            f"of images, matches lie over {_MAX_ERROR:g} pixels off their epipolar lines or behind "
            "the camera: are the poses camera-to-world instead of world-to-camera, with other axes "
            "(OpenGL), or of other images, or is --camera wrong?"
        )
