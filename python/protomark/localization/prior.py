"""A rough pose, and the landmarks that are visible from near it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.camera import Camera
from protomark.geometry.pose import camera_centers

# Number of points along each border of the image, as distortion bends the borders.
_BORDER = 33
# Positions that are looked at together, as each takes some hundred bytes meanwhile.
_PART = 1 << 17


@dataclass(frozen=True)
class PosePrior:
    """A rough pose of a camera, from odometry, GPS or the previous frame.

    Attributes:
        cam_from_world: (3, 4) float64.
        distance: largest error of the camera centre, in world units.
        degrees: largest error of the orientation, in degrees.

    Raises:
        ValueError: the pose is not a finite (3, 4) matrix, or an error is negative.
    """

    cam_from_world: NDArray[np.float64]
    distance: float
    degrees: float

    def __post_init__(self) -> None:
        shape = np.shape(self.cam_from_world)
        if shape != (3, 4) or not np.isfinite(self.cam_from_world).all():
            raise ValueError(f"a prior pose is a finite (3, 4) matrix, not {shape}")
        if not (self.distance >= 0 and self.degrees >= 0):
            raise ValueError(
                f"distance {self.distance} and degrees {self.degrees} of a prior pose must be 0 or "
                "more"
            )


def visible(prior: PosePrior, camera: Camera, positions: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether each position is in the image of some pose that the prior allows.

    No such position is missed; a few others may be included, and occlusion is ignored.

    Args:
        prior: the rough pose.
        camera: the camera.
        positions: (n, 3) float64, world coordinates, NaN for none.

    Returns:
        (n,) bool, False for NaN.
    """
    normals, parts = _field_of_view(camera), range(0, len(positions), _PART)
    found = [_visible(prior, normals, positions[i : i + _PART]) for i in parts]
    return np.concatenate([*found, np.zeros(0, bool)])


def _visible(
    prior: PosePrior, normals: NDArray[np.float64], positions: NDArray[np.float64]
) -> NDArray[np.bool_]:
    offset = positions - camera_centers(prior.cam_from_world)
    distance = np.linalg.norm(offset, axis=1)
    finite = np.isfinite(distance)
    offset, distance = np.where(finite[:, None], offset, 0.0), np.where(finite, distance, 0.0)
    # An error of the centre can change a landmark's direction by the arcsine of this ratio, and by
    # any angle if the landmark is nearer than the error.
    near = distance <= prior.distance
    ratio = np.where(near, 1.0, prior.distance / np.where(near, 1.0, distance))
    slack = np.arcsin(np.clip(ratio, 0.0, 1.0)) + np.radians(prior.degrees)
    direction = offset @ prior.cam_from_world[:, :3].T / np.maximum(distance, 1e-300)[:, None]
    inside = np.arcsin(np.clip(direction @ normals.T, -1.0, 1.0)).min(axis=1, initial=np.pi)
    return finite & (near | (inside >= -slack))


def _field_of_view(camera: Camera) -> NDArray[np.float64]:
    """Inward normals (s, 3) of planes through the camera centre that bound its field of view.

    A field of view of 180 degrees or more has none.
    """
    t = np.linspace(0, 1, _BORDER)
    w, h = camera.width * t, camera.height * t
    zero, one = np.zeros(_BORDER), np.ones(_BORDER)
    border = np.concatenate(
        [
            np.column_stack([w, zero]),
            np.column_stack([w, camera.height * one]),
            np.column_stack([zero, h]),
            np.column_stack([camera.width * one, h]),
        ]
    )
    rays = camera.rays(border)
    if not np.isfinite(rays).all() or np.abs(rays).max() > 1e3:
        return np.zeros((0, 3))
    (left, top), (right, bottom) = rays.min(axis=0), rays.max(axis=0)
    planes = np.array([[1, 0, -left], [-1, 0, right], [0, 1, -top], [0, -1, bottom]], np.float64)
    return np.asarray(planes / np.linalg.norm(planes, axis=1, keepdims=True))
