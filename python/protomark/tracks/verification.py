"""Judges given poses by matches that a two-view model verifies, and finds what never moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from protomark.extras import optional
from protomark.progress import Progress
from protomark.threads import parallel_map
from protomark.tracks.matching import VerifiedMatches, View, match, with_errors

Pairs = dict[tuple[int, int], VerifiedMatches]

# Neighbours tell enough about all poses if some from everywhere in the sequence are looked at.
_STEPS = (1, 2, 4)
_STARTS = 20
# Matches within this many pixels of the epipolar lines of their own two-view model are verified.
_VERIFIED_ERROR = 2.0
_MIN_MATCHES = 20
# With a smaller share of all matches a two-view model may be chance.
_MIN_SHARE = 0.3
# Matches that move less stand still, those that move more tell that the camera moves, pixels.
_STATIC, _MOVING = 1.5, 4.0
# Cells along the longer side of an image, and matches in a cell that never moves.
_CELLS = 32
_STATIC_MATCHES = 5
_STATIC_SHARE = 0.7
# What a camera circles around never moves either, but fills few cells.
_MIN_CELLS = 6


def sample_matches(views: Sequence[View], ratio: float, threads: int, progress: Progress) -> Pairs:
    """Matches of some neighbours all over the sequence, whatever their poses are."""
    count = len(views)
    starts = np.unique(np.linspace(0, count - 1, _STARTS).astype(int))
    chosen = [(int(i), int(i) + step) for i in starts for step in _STEPS if i + step < count]
    found = parallel_map(
        lambda pair: match(views[pair[0]], views[pair[1]], ratio, np.inf),
        chosen,
        threads,
        progress,
        "judge poses",
    )
    return dict(zip(chosen, found, strict=True))


def verify(views: Sequence[View], matches: Pairs) -> Pairs:
    """The matches that essential matrices explain (PoseLib's LO-RANSAC), of pairs with enough."""
    out = {}
    for (i, j), pair in matches.items():
        first, second = views[i], views[j]
        rays = np.hstack([first.rays[pair.rows[:, 0]], second.rays[pair.rows[:, 1]]])
        pair = pair.where(np.asarray(np.isfinite(rays).all(1)))
        if len(pair) < _MIN_MATCHES:
            continue
        focal = 0.5 * (first.focal + second.focal)
        camera = {"model": "PINHOLE", "width": 1, "height": 1, "params": [focal, focal, 0, 0]}
        _, found = optional("poselib").estimate_relative_pose(
            focal * first.rays[pair.rows[:, 0]],
            focal * second.rays[pair.rows[:, 1]],
            camera,
            camera,
            {
                "max_epipolar_error": _VERIFIED_ERROR,
                "min_iterations": 50,
                "max_iterations": 1000,
                "seed": 0,
            },
        )
        inliers = np.asarray(found["inliers"], bool)
        if inliers.sum() >= max(_MIN_MATCHES, _MIN_SHARE * len(pair)):
            out[i, j] = pair.where(inliers)
    return out


def pose_errors(views: Sequence[View], verified: Pairs) -> list[NDArray[np.float64]]:
    """Epipolar errors of verified matches under the poses of the views, pixels, for each pair."""
    return [with_errors(pair, views[i], views[j]).errors for (i, j), pair in verified.items()]


class StaticRegion:
    """The part of the image whose keypoints never move, though the others do: overlays, bonnets.

    Attributes:
        cells: (rows, columns) bool.
    """

    def __init__(
        self, keypoints: Sequence[NDArray[np.float32]], matches: Pairs, size: tuple[int, int]
    ) -> None:
        self._cell = max(size) / _CELLS
        rows, columns = (int(np.ceil(length / self._cell)) for length in (size[1], size[0]))
        still, everything = np.zeros((2, rows, columns))
        for (i, j), pair in matches.items():
            at = keypoints[i][pair.rows[:, 0]]
            moved = np.linalg.norm(at - keypoints[j][pair.rows[:, 1]], axis=1)
            if (moved > _MOVING).sum() < max(_MIN_MATCHES, _MIN_SHARE * len(pair)):
                continue
            cell = self._cells_of(at, still.shape)
            np.add.at(everything, cell, 1)
            np.add.at(still, cell, moved < _STATIC)
        static = (still >= _STATIC_MATCHES) & (still >= _STATIC_SHARE * everything)
        # Around such cells there may be too few keypoints to say.
        cv2 = optional("cv2")
        around = cv2.dilate(static.astype(np.uint8), np.ones((3, 3), np.uint8))
        count, part = cv2.connectedComponents(around)
        large = np.bincount(part[static], minlength=count) >= _MIN_CELLS
        self.cells = large[part] & (still >= 0.5 * everything)

    def _cells_of(
        self, pixels: NDArray[np.float32], shape: tuple[int, ...]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        x, y = (pixels / self._cell).astype(np.int64).T
        return np.clip(y, 0, shape[0] - 1), np.clip(x, 0, shape[1] - 1)

    def contains(self, pixels: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Which of the pixels (n, 2) lie in it."""
        return np.asarray(self.cells[self._cells_of(pixels, self.cells.shape)])

    def box(self) -> list[int]:
        """Left, top, right and bottom of a box around it, pixels; empty if there is none."""
        y, x = np.nonzero(self.cells)
        if not len(x):
            return []
        corners = (x.min(), y.min(), x.max() + 1, y.max() + 1)
        return [round(self._cell * float(corner)) for corner in corners]
