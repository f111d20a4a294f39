"""The probability that a pose is right, given the matches that agree with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.camera import Camera
from protomark.match_calibration import sigmoid

# Cells per side of a grid over the image: inliers in few cells are weak evidence.
CELLS = 10
# Fitted by benchmarks/scripts/localization_confidence.py to the training and validation sequences,
# with codes of 16 and 32 numbers: the constant, then the weights of `Evidence.features`.
WEIGHTS = (-14.94, 3.716, 4.628, 3.015)


@dataclass(frozen=True)
class Evidence:
    """The evidence for a pose.

    Attributes:
        inliers: number of matches that agree with the pose.
        matches: number of accepted matches.
        cells: number of cells, of `CELLS` x `CELLS` over the image, with an inlier.
    """

    inliers: int
    matches: int
    cells: int

    @classmethod
    def of(cls, camera: Camera, inliers: NDArray[np.float64], matches: int) -> Evidence:
        """The evidence of inliers at pixels (i, 2), among a number of accepted matches."""
        size = np.array([camera.width, camera.height])
        cell = np.clip(inliers * CELLS / size, 0, CELLS - 1).astype(np.int64)
        occupied = len(np.unique(cell[:, 0] * CELLS + cell[:, 1]))
        return cls(len(inliers), matches, occupied)

    def features(self) -> NDArray[np.float64]:
        """The features (3,) float64 of the logistic regression."""
        share = self.inliers / max(self.matches, 1)
        return np.array([np.log(max(self.inliers, 1)), share, np.log(max(self.cells, 1))])


def confidence(evidence: Evidence) -> float:
    """Probability that a pose with this evidence is right."""
    return float(sigmoid(WEIGHTS[0] + evidence.features() @ np.array(WEIGHTS[1:])))
