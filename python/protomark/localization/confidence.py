"""The probability that a pose is right, given the matches that agree with it.

Two things must hold: the matches are of this place, and the camera is the one that took the image.
The second shows when the lens is set free: if focal length and principal point may move, a right
camera hardly moves and explains no more matches, unless the scene is too flat to tell.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.camera import Camera
from protomark.match_calibration import sigmoid

# A pose is right if it is off by at most this share of the median depth, and this angle.
DEPTH_SHARE, DEGREES = 0.05, 5.0
# Cells per side of a grid over the image: inliers in few cells are weak evidence.
CELLS = 10
# The origin of a camera: the map was made with it, the user knows it, or localizing estimates it.
CameraOrigin = Literal["map", "user", "estimate"]
# Fitted by benchmarks/scripts/localization_confidence.py to the training and validation sequences,
# with codes of 16 and 32 numbers: the constant, then the weights of `Evidence.place`; and, for each
# origin, the weights of `Evidence.lens`.
PLACE_WEIGHTS: tuple[float, ...] = (-21.38, 4.15, 11.97, 5.738)
LENS_WEIGHTS: dict[CameraOrigin, tuple[float, ...]] = {
    "map": (2.777, -0.6036, 1.13, -23.42, -2.489),
    "user": (3.14, -3.816, 2.177, -11.86, 0.3014),
    "estimate": (-1.518, -1.413, 1.484, -1.539, -0.5986),
}


@dataclass(frozen=True)
class Evidence:
    """The evidence for a pose."""

    inliers: int  # number of matches that agree with the pose
    matches: int  # number of accepted matches
    cells: int  # number of cells, of `CELLS` x `CELLS` over the image, with an inlier
    origin: CameraOrigin = "user"  # where the camera comes from
    # By how much the pose moves if the lens is set free, in units of `DEPTH_SHARE` of the median
    # depth or of `DEGREES`, whichever is more.
    shift: float = np.inf
    gain: float = 0.0  # by how much that lowers the mean (Cauchy) loss of the matches
    # Standard deviation of the camera centre, as a share of the depth, with a free lens.
    spread: float = np.inf
    # The focal length that fits best with a free lens, by that of the camera, and its standard
    # deviation; `shared_camera` compares it over several images.
    stretch: float = 1.0
    deviation: float = np.inf

    def place(self) -> NDArray[np.float64]:
        """Features (3,) float64 of whether the matches are of this place."""
        share = self.inliers / max(self.matches, 1)
        return np.array([np.log(max(self.inliers, 1)), share, np.log(max(self.cells, 1))])

    def lens(self) -> NDArray[np.float64]:
        """Features (4,) float64 of whether the camera is the right one."""
        shift = np.log(np.clip(self.shift, 0.3, 20))
        return np.array(
            [
                shift,
                max(shift, 0.0),
                np.sqrt(np.clip(self.gain, 0, 1)),
                np.log(np.clip(self.spread, 1e-3, 1)),
            ]
        )


def occupied_cells(camera: Camera, pixels: NDArray[np.float64]) -> int:
    """Number of cells of a grid over the image with one of the pixels (n, 2)."""
    size = np.array([camera.width, camera.height])
    cell = np.clip(pixels * CELLS / size, 0, CELLS - 1).astype(np.int64)
    return len(np.unique(cell[:, 0] * CELLS + cell[:, 1]))


# Smallest probability of a pose that is accepted.
MIN_CONFIDENCE = 0.9


def confidence(evidence: Evidence) -> float:
    """Probability that a pose with this evidence is right."""
    return place_probability(evidence) * _lens(evidence)


def doubt(evidence: Evidence) -> str:
    """A sentence if the camera is what makes a pose unlikely, else ""."""
    if place_probability(evidence) < 0.5 or _lens(evidence) >= 0.5:
        return ""
    return (
        "the matches do not confirm this camera: is its calibration right, and of this resolution?"
    )


def place_probability(evidence: Evidence) -> float:
    """Probability that the matches are of this place, whatever the camera."""
    return float(sigmoid(PLACE_WEIGHTS[0] + evidence.place() @ np.array(PLACE_WEIGHTS[1:])))


def _lens(evidence: Evidence) -> float:
    weights = LENS_WEIGHTS[evidence.origin]
    return float(sigmoid(weights[0] + evidence.lens() @ np.array(weights[1:])))
