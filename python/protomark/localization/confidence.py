"""How likely a pose is right, given the matches that agree with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.camera import Camera
from protomark.match_calibration import sigmoid

# Cells per side of a grid over the image, in which occupied cells are counted: many inliers on one
# spot of the image say little.
CELLS = 10
# Fitted by benchmarks/scripts/localization_confidence.py to the training and validation sequences,
# with codes of 16 and 32 numbers: the constant, then the weights of `Evidence.features`.
WEIGHTS = (-14.94, 3.716, 4.628, 3.015)


@dataclass(frozen=True)
class Evidence:
    """What speaks for a pose.

    Attributes:
        inliers: matches that agree with it.
        matches: accepted matches.
        cells: cells of the image, of `CELLS` x `CELLS`, that hold an inlier.
    """

    inliers: int
    matches: int
    cells: int

    @classmethod
    def of(cls, camera: Camera, inliers: NDArray[np.float64], matches: int) -> Evidence:
        """Evidence from the pixels (i, 2) of the inliers, and the number of accepted matches."""
        size = np.array([camera.width, camera.height])
        cell = np.clip(inliers * CELLS / size, 0, CELLS - 1).astype(np.int64)
        occupied = len(np.unique(cell[:, 0] * CELLS + cell[:, 1]))
        return cls(len(inliers), matches, occupied)

    def features(self) -> NDArray[np.float64]:
        """The (3,) float64 that the probability depends on."""
        share = self.inliers / max(self.matches, 1)
        return np.array([np.log(max(self.inliers, 1)), share, np.log(max(self.cells, 1))])


def confidence(evidence: Evidence) -> float:
    """Probability that a pose with this evidence is right."""
    return float(sigmoid(WEIGHTS[0] + evidence.features() @ np.array(WEIGHTS[1:])))
