"""A new frame against the map: matches with what its landmarks keep, and its pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.absolute_pose import estimate_pose, refine_pose, reprojection_error
from protomark.geometry.neighbours import near_pairs, runs
from protomark.mapping.frame import Array, Frame, Ids
from protomark.mapping.memory import Memory
from protomark.mapping.structure import Structure

# Radii of the search around projected landmarks, as shares of the image's longer side: under a
# predicted pose, and under a pose found by RANSAC.
_PREDICTED_RADIUS = 0.06
_FOUND_RADIUS = 0.02
# A prediction off by more than this (median) leaves right matches outside of its radius.
_LARGE_OFFSET = 0.5 * _PREDICTED_RADIUS
# Landmarks that project this close to each other (pixels) may be duplicates, so the ratio test does
# not compare them.
_SAME_PLACE = 3.0
_SAMPLE = 997
# Share of the keypoints, or of the landmarks in view if these are fewer, that must match.
_MIN_SEEN = 0.03


@dataclass
class LandmarkMatches:
    """k keypoints with the landmark that each may see, the clearest first; each occurs once.

    Attributes:
        rows: (k,) int64, keypoint.
        ids: (k,) int64, landmark.
    """

    rows: Ids
    ids: Ids

    def __len__(self) -> int:
        return len(self.rows)

    def where(self, keep: NDArray[np.bool_]) -> LandmarkMatches:
        """The matches for which `keep` (k,) is true."""
        return LandmarkMatches(self.rows[keep], self.ids[keep])


@dataclass
class TrackedPose:
    """A pose that was found for a frame.

    Attributes:
        pose: (3, 4) float64, cam_from_world.
        matches: the matches that agree with it.
        share: their share of the landmarks in view, or of the keypoints if these are fewer.
    """

    pose: Array
    matches: LandmarkMatches
    share: float = 1.0


class Tracker:
    """Finds frames in a map.

    Args:
        structure: where landmarks are.
        memory: what they look like.
        max_error: largest reprojection error, as a share of the image's longer side.
        min_inliers: fewest matches that must agree with a pose.
        threads: threads to search on; the result is the same.
    """

    def __init__(
        self,
        structure: Structure,
        memory: Memory,
        max_error: float,
        min_inliers: int,
        threads: int = 1,
    ) -> None:
        self.structure, self.memory = structure, memory
        self.max_error, self.min_inliers, self.threads = max_error, min_inliers, threads

    def track(self, frame: Frame, predicted: Array) -> TrackedPose | None:
        """The pose of a frame that should be near a predicted one (ORB-SLAM's motion model)."""
        found = self._solve(frame, self.match_projected(frame, predicted, _PREDICTED_RADIUS))
        if found and self._misses_matches(frame, predicted, found):
            # The matches on one side of the radius also fit a wrong pose: search around that one.
            found = self._solve(frame, self.match_projected(frame, found.pose, _PREDICTED_RADIUS))
        return self.track_local_map(frame, found.pose) if found else None

    def _misses_matches(self, frame: Frame, predicted: Array, found: TrackedPose) -> bool:
        """Whether the prediction was so far off that its radius missed many right matches."""
        off = reprojection_error(
            predicted,
            frame.keypoints[found.matches.rows].astype(np.float64),
            self.structure.positions[found.matches.ids],
            self.structure.cameras[frame.camera_id],
        )
        return bool(np.median(off) > self.structure.tolerance(frame.camera_id, _LARGE_OFFSET))

    def relocalize(self, frame: Frame, among: Ids | None = None) -> TrackedPose | None:
        """The pose of a frame that may be anywhere, by search in the whole map.

        Args:
            frame: the frame.
            among: landmarks to search, ascending; None: all.
        """
        return self._solve(frame, self.search(frame, among))

    def track_among(self, frame: Frame, predicted: Array, among: Ids) -> TrackedPose | None:
        """The pose of a frame near a predicted one, by some landmarks only."""
        return self._solve(frame, self.match_projected(frame, predicted, _PREDICTED_RADIUS, among))

    def track_local_map(
        self, frame: Frame, pose: Array, among: Ids | None = None
    ) -> TrackedPose | None:
        """Match all landmarks in view under a rough pose, and refine the pose on them.

        None if too few of the landmarks in view match: a wrong pose finds some matches, too.
        """
        matches = self.match_projected(frame, pose, _FOUND_RADIUS, among)
        for _ in range(2):
            pose, inliers = self._refine(frame, matches, pose)
            matches = self.match_projected(frame, pose, _FOUND_RADIUS, among)
        pose, inliers = self._refine(frame, matches, pose)
        visible = len(self.structure.visible(pose, frame.camera_id)[0])
        share = float(inliers.sum()) / max(min(visible, len(frame.keypoints)), 1)
        if inliers.sum() < self.min_inliers or share < _MIN_SEEN:
            return None
        return TrackedPose(pose, matches.where(inliers), share)

    def search(self, frame: Frame, among: Ids | None = None) -> LandmarkMatches:
        """Nearest landmark of each keypoint in the whole map, where the match is accepted."""
        ids, distances = self.memory.search(frame.codes, self.threads, among)
        rows = self.memory.accepted(distances)
        return _unique_landmarks(rows, ids[rows, 0])

    def match_projected(
        self, frame: Frame, pose: Array, radius: float, among: Ids | None = None
    ) -> LandmarkMatches:
        """Nearest landmark of each keypoint among those that project within `radius` of it."""
        structure = self.structure
        pixels = structure.tolerance(frame.camera_id, radius)
        ids, places = structure.visible(pose, frame.camera_id, margin=pixels)
        if among is not None:
            chosen = np.isin(ids, among)
            ids, places = ids[chosen], places[chosen]
        rows, near = near_pairs(frame.keypoints.astype(np.float64), places, pixels)
        if not len(rows):
            return LandmarkMatches(rows, rows)
        distance = self.memory.distances(frame.codes, rows, ids[near])
        # For each keypoint the nearest landmark (pairs ascend in id, so of equals the lowest id),
        # and the nearest one elsewhere in the image.
        starts, lengths = runs(rows)
        run = np.repeat(np.arange(len(starts)), lengths)
        first = np.minimum.reduceat(distance, starts)
        nearest = np.flatnonzero(distance == first[run])
        best = near[nearest[runs(run[nearest])[0]]]
        x, y = places.T
        off = (x[near] - x[best][run]) ** 2 + (y[near] - y[best][run]) ** 2
        other = np.where(off > _SAME_PLACE**2, distance.astype(np.float64), np.inf)
        second = np.minimum.reduceat(other, starts)
        with np.errstate(invalid="ignore"):
            fits = first < self.memory.guided_ratio * second
        fits &= first < self.memory.max_distance * self._typical_distance(frame, ids)
        rows, best, first = rows[starts[fits]], best[fits], first[fits]
        order = np.lexsort((rows, first))
        return _unique_landmarks(rows[order], ids[best[order]])

    def _typical_distance(self, frame: Frame, ids: Ids) -> float:
        count = min(_SAMPLE, len(frame.codes) * len(ids))
        pick = np.arange(count) * 7919
        rows, others = pick % len(frame.codes), ids[pick % len(ids)]
        return float(np.median(self.memory.distances(frame.codes, rows, others)))

    def _solve(self, frame: Frame, matches: LandmarkMatches) -> TrackedPose | None:
        if len(matches) < self.min_inliers:
            return None
        camera = self.structure.cameras[frame.camera_id]
        found = estimate_pose(
            frame.keypoints[matches.rows].astype(np.float64),
            self.structure.positions[matches.ids],
            camera,
            self.structure.tolerance(frame.camera_id, self.max_error),
        )
        if found is None or found.inliers.sum() < self.min_inliers:
            return None
        return TrackedPose(found.cam_from_world, matches.where(found.inliers))

    def _refine(
        self, frame: Frame, matches: LandmarkMatches, pose: Array
    ) -> tuple[Array, NDArray[np.bool_]]:
        return refine_pose(
            pose,
            frame.keypoints[matches.rows].astype(np.float64),
            self.structure.positions[matches.ids],
            self.structure.cameras[frame.camera_id],
            self.structure.tolerance(frame.camera_id, self.max_error),
            self.structure.weights(pose, matches.ids),
        )


def _unique_landmarks(rows: Ids, ids: Ids) -> LandmarkMatches:
    """Keep the first of several keypoints with one landmark."""
    _, first = np.unique(ids, return_index=True)
    first.sort()
    return LandmarkMatches(rows[first], ids[first])
