"""A new frame against the map: matches with what its landmarks keep, and its pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from protomark.mapping.memory import Memory
from protomark.mapping.pose import absolute_pose, refine_pose, reprojection_error
from protomark.mapping.structure import Array, Ids, Structure
from protomark.mapping.thresholds import accepted, thresholds
from protomark.tracks.geometry import group
from protomark.tracks.nearby import near_pairs

# Radii in which landmarks are looked for, as shares of the image's longer side: around where a
# predicted pose puts them, and around where a pose found by RANSAC does.
_PREDICTED_RADIUS = 0.06
_FOUND_RADIUS = 0.02
# A prediction off by more than this (median) leaves right matches outside of its radius.
_FAR_OFF = 0.5 * _PREDICTED_RADIUS
# Landmarks that project this close to each other (pixels) may be one, made twice: the ratio test
# does not hold them against each other.
_SAME_PLACE = 3.0
_SAMPLE = 997
# Share of the keypoints, or of the landmarks in view if these are fewer, that must match.
_MIN_SEEN = 0.03


@dataclass
class Matches:
    """k keypoints with the landmark that each may see, clearest first; each occurs once.

    Attributes:
        rows: (k,) int64, keypoint.
        ids: (k,) int64, landmark.
    """

    rows: Ids
    ids: Ids

    def __len__(self) -> int:
        return len(self.rows)

    def where(self, keep: NDArray[np.bool_]) -> Matches:
        """Those for which `keep` (k,) is true."""
        return Matches(self.rows[keep], self.ids[keep])


class Query(Protocol):
    """What a frame that looks for its pose must tell: a `Sighting`, or a `Frame` of the window."""

    @property
    def camera_id(self) -> int:
        """Its camera."""

    @property
    def keypoints(self) -> NDArray[np.float32]:
        """(n, 2) pixels."""

    @property
    def encoded(self) -> Any:
        """(n, width), descriptors as the memory compares them."""


@dataclass
class Tracked:
    """A pose.

    Attributes:
        pose: (3, 4) float64, cam_from_world.
        matches: those that agree with it.
        share: how many they are of the landmarks in view, or of the keypoints if these are fewer.
    """

    pose: Array
    matches: Matches
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
        self.bounds = thresholds(memory)

    def track(self, query: Query, predicted: Array) -> Tracked | None:
        """The pose of a frame that should be near a predicted one."""
        found = self._solve(query, self.guided(query, predicted, _PREDICTED_RADIUS))
        if found and self._cut_off(query, predicted, found):
            # What is left on one side of the radius fits a wrong pose, too: look around that one.
            found = self._solve(query, self.guided(query, found.pose, _PREDICTED_RADIUS))
        return self.settle(query, found.pose) if found else None

    def _cut_off(self, query: Query, predicted: Array, found: Tracked) -> bool:
        """Whether the prediction was so far off that its radius left out many right matches."""
        off = reprojection_error(
            self.structure.cameras[query.camera_id],
            query.keypoints[found.matches.rows].astype(np.float64),
            self.structure.positions[found.matches.ids],
            predicted,
        )
        return bool(np.median(off) > self.structure.tolerance(query.camera_id, _FAR_OFF))

    def relocalize(self, query: Query, among: Ids | None = None) -> Tracked | None:
        """The pose of a frame that may be anywhere, by prototypes of the whole map alone.

        Args:
            query: the frame.
            among: landmarks to search, ascending; None: all.
        """
        return self._solve(query, self.search(query, among))

    def near(self, query: Query, predicted: Array, among: Ids) -> Tracked | None:
        """The pose of a frame near a predicted one, by some landmarks only."""
        return self._solve(query, self.guided(query, predicted, _PREDICTED_RADIUS, among))

    def settle(self, query: Query, pose: Array, among: Ids | None = None) -> Tracked | None:
        """From a rough pose to all that the frame sees, and to the pose that they give.

        None if that is too little of what should be in view: a wrong pose finds matches, too.
        """
        matches = self.guided(query, pose, _FOUND_RADIUS, among)
        for _ in range(2):
            pose, inliers = self._refine(query, matches, pose)
            matches = self.guided(query, pose, _FOUND_RADIUS, among)
        pose, inliers = self._refine(query, matches, pose)
        visible = len(self.structure.visible(pose, query.camera_id)[0])
        share = float(inliers.sum()) / max(min(visible, len(query.keypoints)), 1)
        if inliers.sum() < self.min_inliers or share < _MIN_SEEN:
            return None
        return Tracked(pose, matches.where(inliers), share)

    def search(self, query: Query, among: Ids | None = None) -> Matches:
        """Nearest landmark of each keypoint in the whole map, where the match is clear."""
        ids, distances = self.memory.search(query.encoded, self.threads, among)
        rows = accepted(self.memory, distances)
        return _one_each(rows, ids[rows, 0])

    def guided(self, query: Query, pose: Array, radius: float, among: Ids | None = None) -> Matches:
        """Nearest landmark of each keypoint among those that project within `radius` of it."""
        structure = self.structure
        pixels = structure.tolerance(query.camera_id, radius)
        ids, places = structure.visible(pose, query.camera_id, margin=pixels)
        if among is not None:
            chosen = np.isin(ids, among)
            ids, places = ids[chosen], places[chosen]
        rows, near = near_pairs(query.keypoints.astype(np.float64), places, pixels)
        if not len(rows):
            return Matches(rows, rows)
        distance = self.memory.distances(query.encoded, rows, ids[near])
        # Of each keypoint the nearest (of equals the lowest id: a run of pairs ascends in it), and
        # the nearest of those at another place.
        starts, lengths = group(rows)
        run = np.repeat(np.arange(len(starts)), lengths)
        first = np.minimum.reduceat(distance, starts)
        nearest = np.flatnonzero(distance == first[run])
        best = near[nearest[group(run[nearest])[0]]]
        x, y = places.T
        off = (x[near] - x[best][run]) ** 2 + (y[near] - y[best][run]) ** 2
        other = np.where(off > _SAME_PLACE**2, distance.astype(np.float64), np.inf)
        second = np.minimum.reduceat(other, starts)
        with np.errstate(invalid="ignore"):
            fits = first < self.bounds.guided_ratio * second
        fits &= first < self.bounds.max_distance * self._typical_distance(query, ids)
        rows, best, first = rows[starts[fits]], best[fits], first[fits]
        order = np.lexsort((rows, first))
        return _one_each(rows[order], ids[best[order]])

    def _typical_distance(self, query: Query, ids: Ids) -> float:
        many = min(_SAMPLE, len(query.encoded) * len(ids))
        pick = np.arange(many) * 7919
        rows, others = pick % len(query.encoded), ids[pick % len(ids)]
        return float(np.median(self.memory.distances(query.encoded, rows, others)))

    def _solve(self, query: Query, matches: Matches) -> Tracked | None:
        if len(matches) < self.min_inliers:
            return None
        camera = self.structure.cameras[query.camera_id]
        found = absolute_pose(
            camera,
            query.keypoints[matches.rows].astype(np.float64),
            self.structure.positions[matches.ids],
            self.structure.tolerance(query.camera_id, self.max_error),
        )
        if found is None or found[1].sum() < self.min_inliers:
            return None
        return Tracked(found[0], matches.where(found[1]))

    def _refine(
        self, query: Query, matches: Matches, pose: Array
    ) -> tuple[Array, NDArray[np.bool_]]:
        return refine_pose(
            self.structure.cameras[query.camera_id],
            query.keypoints[matches.rows].astype(np.float64),
            self.structure.positions[matches.ids],
            pose,
            self.structure.tolerance(query.camera_id, self.max_error),
            self.structure.certainty(pose, matches.ids),
        )


def _one_each(rows: Ids, ids: Ids) -> Matches:
    """Of several keypoints with one landmark the first."""
    _, first = np.unique(ids, return_index=True)
    first.sort()
    return Matches(rows[first], ids[first])
