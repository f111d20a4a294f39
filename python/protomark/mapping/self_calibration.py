"""Self-calibration: which focal lengths a map may start with, and whether it proves its own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from protomark.extras import optional
from protomark.geometry.absolute_pose import MIN_ITERATIONS
from protomark.geometry.camera import Camera
from protomark.mapping.survey import MatchedPair

CALIBRATED_MODEL = "SIMPLE_RADIAL"
# Focal lengths of lenses, as shares of the image's longer side. Distortion moves a point that is
# seen at an angle of tangent r by at most this share of its distance from the centre, and by this
# times r squared: only wide lenses distort much.
MIN_FOCAL, MAX_FOCAL = 0.3, 3.0
_MAX_DISTORTION, _MAX_COEFFICIENT = 0.3, 0.6
# A calibration is determined once its focal length has at most this relative deviation: larger ones
# come with errors of 20 %, as errors of neighbouring frames are alike.
MAX_DEVIATION = 0.01
# A pair of frames votes if some focal length makes the singular values of its essential matrix
# equal up to this share.
_MAX_ASYMMETRY = 0.02
# The votes within this factor of the elected focal length must be this share of all pairs.
_AGREEMENT = 1.2
_MIN_AGREEING = 0.25
_MIN_VOTES = 8
_MIN_INLIERS = 50
# The map restarts if its focal length proves to be off by more than this share, as its first frames
# are bent. After a restart, later estimates are taken once they are about as certain.
_MAX_OFFSET = 0.05
MAX_RESTARTS = 3
_RESTART_SLACK = 1.5


@dataclass
class Calibration:
    """How far a map in the making has determined its camera."""

    start: float  # focal length that the map started with, pixels
    # Relative deviation above which an estimate of the focal length is not taken.
    limit: float = MAX_DEVIATION
    # Relative deviation of the focal length, infinite while it is not determined.
    deviation: float = math.inf
    restarts: int = 0  # number of times that the map has started again
    given: bool = False  # whether the start comes from the user or the camera and not from a guess
    guessed: bool = False  # whether it is a guess, and no other start has competed with it yet
    # Focal lengths that fit the finished map as well as its own, pixels.
    others: list[float] = field(default_factory=list)

    @property
    def determined(self) -> bool:
        """Whether the images determine the focal length."""
        return math.isfinite(self.deviation) and not self.others

    def accept(self, cameras: Sequence[Camera], deviation: float) -> bool:
        """Whether adjusted cameras are plausible, and the images determine them.

        `deviation` is the largest relative deviation of a focal length.
        """
        for camera in cameras:
            params = camera.params
            if not np.isfinite(params).all() or params[0] <= 0 or not is_plausible(camera):
                return False
        if not deviation <= self.limit:
            return False
        self.deviation = deviation
        return True

    def needs_restart(self, focal_length: float) -> bool:
        """Whether the focal length proved so different from the start that the map is bent."""
        if self.restarts == MAX_RESTARTS or not self.determined:
            return False
        return abs(focal_length / self.start - 1) > _MAX_OFFSET

    def restarted(self, focal_length: float) -> Calibration:
        """The calibration of a map that starts with what this one determined."""
        limit = min(self.limit, _RESTART_SLACK * self.deviation)
        again = self.restarts + 1
        return Calibration(focal_length, limit, self.deviation, again, self.given, self.guessed)


def is_plausible(camera: Camera) -> bool:
    """Whether a calibrated camera is one that lenses make."""
    focal = camera.focal_length
    if not MIN_FOCAL <= focal / max(camera.width, camera.height) <= MAX_FOCAL:
        return False
    half = np.array([camera.width, camera.height]) / 2
    pixel = camera.project(np.append(half / focal, 1.0)[None])[0]
    radius = float(np.linalg.norm(half / focal))
    stretch = float(np.linalg.norm(pixel - half) / focal) / radius
    return abs(stretch - 1) <= min(_MAX_DISTORTION, _MAX_COEFFICIENT * radius**2)


def elect_focal_length(pairs: Sequence[MatchedPair], size: tuple[int, int]) -> float | None:
    """The focal length in pixels that most pairs of frames vote for; None if they do not agree.

    A fundamental matrix F between two images of one camera K fixes its focal length: the essential
    matrix K^T F K has two equal singular values (Kruppa's equations). One pair is noisy, and
    planes and some motions leave it open, so many pairs vote.
    """
    poselib = optional("poselib")
    longer_side = max(size)
    focals = longer_side * np.geomspace(MIN_FOCAL, MAX_FOCAL, 93)
    options = {
        "max_epipolar_error": max(0.003 * longer_side, 1.5),
        "min_iterations": MIN_ITERATIONS,
        "max_iterations": 1000,
        "seed": 0,
    }
    votes = []
    for pair in pairs:
        first, second = (p - np.array(size) / 2 for p in (pair.first, pair.second))
        matrix, facts = poselib.estimate_fundamental(first, second, options, {})
        if np.asarray(facts["inliers"], bool).sum() < _MIN_INLIERS:
            continue
        scale = np.ones((len(focals), 3))
        scale[:, :2] = focals[:, None]
        essential = scale[:, :, None] * np.asarray(matrix) * scale[:, None, :]
        singular = np.linalg.svd(essential, compute_uv=False)
        asymmetry = 1 - singular[:, 1] / singular[:, 0]
        best = int(np.argmin(asymmetry))
        if 0 < best < len(focals) - 1 and asymmetry[best] < _MAX_ASYMMETRY:
            votes.append(math.log(focals[best]))
    if len(votes) < _MIN_VOTES:
        return None
    ballot = np.array(votes)
    near = np.abs(ballot[:, None] - ballot) < math.log(_AGREEMENT)
    elected = near[int(near.sum(1).argmax())]
    if elected.sum() < max(_MIN_VOTES, _MIN_AGREEING * len(pairs)):
        return None
    return math.exp(float(np.median(ballot[elected])))
