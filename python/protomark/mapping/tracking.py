"""Tracks and relocalizes frames: matches them with landmarks, and estimates their poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.absolute_pose import estimate_pose, refine_pose
from protomark.geometry.neighbours import near_pairs, runs
from protomark.mapping.frame import Array, Frame, Ids
from protomark.mapping.memory import Memory
from protomark.mapping.structure import Structure

# Radius of the search around projected landmarks, as a share of the image's longer side: under a
# predicted pose, and under a pose found by RANSAC.
_PREDICTED_RADIUS = 0.06
_FOUND_RADIUS = 0.02
# A prediction that is off by more than this (median) leaves right matches outside of its radius.
_LARGE_OFFSET = 0.5 * _PREDICTED_RADIUS
# The ratio test does not compare landmarks that project this close to each other (pixels), as they
# may be duplicates.
_SAME_PLACE = 3.0
_SAMPLE = 997
# This share of the keypoints, or of the landmarks in view if these are fewer, must match.
_MIN_SEEN = 0.03
# This share of the matches that should be right must agree with a pose found anywhere in the map.
_MIN_EXPECTED = 0.2


@dataclass
class LandmarkMatches:
    """k matches of keypoints with landmarks, the clearest first; each occurs once."""

    rows: Ids  # (k,) int64, row of the keypoint in its frame
    ids: Ids  # (k,) int64, landmark

    def __len__(self) -> int:
        return len(self.rows)

    def where(self, keep: NDArray[np.bool_]) -> LandmarkMatches:
        """The matches for which `keep` (k,) is true."""
        return LandmarkMatches(self.rows[keep], self.ids[keep])


@dataclass
class TrackedPose:
    """The pose of a frame."""

    pose: Array  # (3, 4) float64, cam_from_world
    matches: LandmarkMatches  # matches that agree with the pose
    # Their share of the landmarks in view, or of the keypoints if these are fewer.
    share: float = 1.0


class Tracker:
    """Finds frames in a map."""

    def __init__(self, structure: Structure, memory: Memory, threads: int = 1) -> None:
        self.structure, self.memory, self.threads = structure, memory, threads
        self.min_inliers = structure.options.min_inliers  # matches that must agree with a pose

    def track(self, frame: Frame, predicted: Array) -> TrackedPose | None:
        """The pose of a frame near a predicted one (ORB-SLAM's motion model)."""
        found = self._solve(frame, self.match_projected(frame, predicted, _PREDICTED_RADIUS))
        if found and self._misses_matches(frame, predicted, found):
            # The matches within the radius also fit a wrong pose: search around the found one.
            found = self._solve(frame, self.match_projected(frame, found.pose, _PREDICTED_RADIUS))
        return self.track_local_map(frame, found.pose) if found else None

    def _misses_matches(self, frame: Frame, predicted: Array, found: TrackedPose) -> bool:
        """Whether the prediction was so far off that right matches lie outside of its radius."""
        matches = found.matches
        off = self.structure.median_error(predicted, frame, matches.rows, matches.ids)
        return off > self.structure.tolerance(frame.camera_id, _LARGE_OFFSET)

    def relocalize(self, frame: Frame, among: Ids | None = None) -> TrackedPose | None:
        """The pose of a frame anywhere in the map, by search among landmarks; None: all of them.

        Returns None if far fewer matches agree on it than the match calibration expects.
        """
        ids, distances = self.memory.search(frame.codes, self.threads, among)
        rows = self.memory.accepted(distances)
        found = self._solve(frame, _unique_landmarks(rows, ids[rows, 0]))
        expected = self.memory.expected(distances[rows])
        return found if found and len(found.matches) >= _MIN_EXPECTED * expected else None

    def track_among(self, frame: Frame, predicted: Array, among: Ids) -> TrackedPose | None:
        """The pose of a frame near a predicted one, by these landmarks only."""
        return self._solve(frame, self.match_projected(frame, predicted, _PREDICTED_RADIUS, among))

    def track_local_map(
        self, frame: Frame, pose: Array, among: Ids | None = None
    ) -> TrackedPose | None:
        """Match all landmarks in view under a rough pose, and refine the pose on them.

        Returns None if too small a share of them matches: a wrong pose finds matches, too.
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

    def match_projected(
        self, frame: Frame, pose: Array, radius: float, among: Ids | None = None
    ) -> LandmarkMatches:
        """Matches of keypoints with the nearest landmark that projects within `radius` of them."""
        structure = self.structure
        pixels = structure.tolerance(frame.camera_id, radius)
        ids, projected = structure.visible(pose, frame.camera_id, margin=pixels)
        if among is not None:
            chosen = np.isin(ids, among)
            ids, projected = ids[chosen], projected[chosen]
        rows, near = near_pairs(frame.keypoints.astype(np.float64), projected, pixels)
        if not len(rows):
            return LandmarkMatches(rows, rows)
        distance = self.memory.distances(frame.codes, rows, ids[near])
        # For each keypoint find the nearest landmark (pairs ascend in id, so ties go to the lowest
        # id), and the nearest one elsewhere in the image.
        starts, lengths = runs(rows)
        run = np.repeat(np.arange(len(starts)), lengths)
        first = np.minimum.reduceat(distance, starts)
        nearest = np.flatnonzero(distance == first[run])
        best = near[nearest[runs(run[nearest])[0]]]
        x, y = projected.T
        apart = (x[near] - x[best][run]) ** 2 + (y[near] - y[best][run]) ** 2
        same_place = _SAME_PLACE * structure.pixel(frame.camera_id)
        other = np.where(apart > same_place**2, distance.astype(np.float64), np.inf)
        second = np.minimum.reduceat(other, starts)
        with np.errstate(invalid="ignore"):
            fits = first < self.memory.guided_ratio * second
        fits &= first < self.memory.max_distance * self._typical_distance(frame, ids)
        rows, best, first = rows[starts[fits]], best[fits], first[fits]
        order = np.lexsort((rows, first))
        return _unique_landmarks(rows[order], ids[best[order]])

    def _typical_distance(self, frame: Frame, ids: Ids) -> float:
        """Median distance of keypoints from landmarks that they do not observe."""
        count = min(_SAMPLE, len(frame.codes) * len(ids))
        pick = np.arange(count) * 7919
        rows, others = pick % len(frame.codes), ids[pick % len(ids)]
        return float(np.median(self.memory.distances(frame.codes, rows, others)))

    def _solve(self, frame: Frame, matches: LandmarkMatches) -> TrackedPose | None:
        if len(matches) < self.min_inliers:
            return None
        found = estimate_pose(
            *self.structure.matched(frame, matches.rows, matches.ids),
            self.structure.max_error(frame.camera_id),
        )
        if found is None or found.inliers.sum() < self.min_inliers:
            return None
        return TrackedPose(found.cam_from_world, matches.where(found.inliers))

    def _refine(
        self, frame: Frame, matches: LandmarkMatches, pose: Array
    ) -> tuple[Array, NDArray[np.bool_]]:
        return refine_pose(
            pose,
            *self.structure.matched(frame, matches.rows, matches.ids),
            self.structure.max_error(frame.camera_id),
            self.structure.weights(pose, matches.ids),
        )


def _unique_landmarks(rows: Ids, ids: Ids) -> LandmarkMatches:
    """Matches of which each landmark keeps the first."""
    _, first = np.unique(ids, return_index=True)
    first.sort()
    return LandmarkMatches(rows[first], ids[first])
