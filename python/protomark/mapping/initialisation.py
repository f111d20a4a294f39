"""The first two frames: their relative pose, once there is enough parallax to trust it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import protomark as pm
from protomark.localization.absolute_pose import MAX_ITERATIONS, MIN_ITERATIONS
from protomark.mapping.pose import absolute_pose, reprojection_error
from protomark.mapping.sighting import Sighting
from protomark.mapping.structure import Array, Ids
from protomark.tracks.colmap import focal_length
from protomark.tracks.file import Camera
from protomark.tracks.geometry import depth_of_first, epipolar_error

RATIO = 0.8
# Fewest matches that must agree with the relative pose.
_MIN_MATCHES = 60
# Median angle between the two rays of a match, degrees.
_MIN_PARALLAX = 2.0
# Where this share of matches is explained by a turn on the spot, there is no parallax.
_MAX_TURNED = 0.7
# Share of the landmarks that other frames see which must agree with a pose of that frame, within
# three quarters of the largest error; and the lead over any other relative pose, which is larger
# where there are few such frames.
_MIN_SUPPORT = 0.7
_LEAD = 1.05
_LEAD_OF_FEW = 1.2
_FEW = 2
_WITNESSES = 4
_MIN_COMMON = 40
# When more wait, every second one goes; it is looked for at the end.
_MAX_WAITING = 40
# A new frame is tried with so many of them at most, from the oldest to the newest.
_PARTNERS = 10


@dataclass
class TwoView:
    """The relative pose of two frames, the first one at the origin.

    Attributes:
        first: place in `Initialiser.waiting`.
        second: place in `Initialiser.waiting`.
        pose: (3, 4) float64, of the second; the translation has length 1.
    """

    first: int
    second: int
    pose: Array


class Initialiser:
    """Collects frames until two of them show the scene from places far enough apart.

    Two views of a plane fit two relative poses, and of little depth nearly so. Other frames that
    wait tell which is right: landmarks of a wrong one do not fit where these saw them.

    Args:
        camera: camera of all frames.
        max_error: largest epipolar error in pixels.
    """

    def __init__(self, camera: Camera, max_error: float) -> None:
        self.camera, self.max_error = camera, max_error
        self.waiting: list[Sighting] = []
        self.best_parallax = 0.0
        self._focal = focal_length(camera)
        self._matches: dict[tuple[str, str], Ids] = {}

    def push(self, sighting: Sighting) -> TwoView | None:
        """Try the new frame with those that wait, the oldest first; it then waits, too.

        With many that wait, some spread evenly over them are tried.
        """
        self.waiting.append(sighting)
        if len(self.waiting) > _MAX_WAITING:
            # Not the oldest: a slow video needs a long way back.
            del self.waiting[1:-1:2]
            self._matches.clear()
        last = len(self.waiting) - 1
        partners = np.linspace(0, last - 1, min(last, _PARTNERS)).round().astype(int)
        for first in partners.tolist():
            pose = self._relative_pose(first, last)
            if pose is not None:
                return TwoView(first, last, pose)
        return None

    def _relative_pose(self, first: int, second: int) -> Array | None:
        one, other = self.waiting[first], self.waiting[second]
        rows = self._match(one, other)
        if len(rows) < _MIN_MATCHES:
            return None
        rays = one.rays[rows[:, 0]], other.rays[rows[:, 1]]
        # Most pairs of a video end here, for little time.
        if _turned(np.eye(3), *rays, self.max_error / self._focal) > _MAX_TURNED:
            return None
        candidates = self._candidates(one, other, rows)
        if not candidates:
            return None
        parallax = [self._parallax(pose, *rays) for pose in candidates]
        if max(parallax) < _MIN_PARALLAX:
            self.best_parallax = max(self.best_parallax, *parallax)
            return None
        witnesses = self._witnesses(first, second)
        scores = [self._support(one, other, rows, pose, witnesses) for pose in candidates]
        best = int(np.argmax([support for support, _ in scores]))
        support, share = scores[best]
        if share < _MIN_SUPPORT:
            return None
        self.best_parallax = max(self.best_parallax, parallax[best])
        if parallax[best] < _MIN_PARALLAX:
            return None
        lead = _LEAD if len(witnesses) > _FEW else _LEAD_OF_FEW
        for pose, (rival, _) in zip(candidates, scores, strict=True):
            if support < lead * rival and not _alike(pose, candidates[best]):
                return None
        return candidates[best]

    def _candidates(self, one: Sighting, other: Sighting, rows: Ids) -> list[Array]:
        """The relative pose that fits best, and those that the scene as a plane allows."""
        import poselib

        camera, focal = self.camera.as_dict(), self._focal
        a, b = (s.keypoints[rows[:, k]].astype(np.float64) for k, s in enumerate((one, other)))
        sampling = {"min_iterations": MIN_ITERATIONS, "max_iterations": MAX_ITERATIONS, "seed": 0}
        options = {"max_epipolar_error": self.max_error, **sampling}
        found, facts = poselib.estimate_relative_pose(a, b, camera, camera, options, {})
        inliers = np.asarray(facts["inliers"], bool)
        if inliers.sum() < _MIN_MATCHES or inliers.mean() < 0.5:
            return []
        ray_a, ray_b = one.rays[rows[:, 0]], other.rays[rows[:, 1]]
        pose = np.asarray(found.Rt, np.float64)
        limit = self.max_error / focal
        if _turned(pose[:, :3], ray_a[inliers], ray_b[inliers], limit) > _MAX_TURNED:
            return []
        plane, facts = poselib.estimate_homography(
            focal * ray_a, focal * ray_b, {"max_reproj_error": self.max_error, **sampling}, {}
        )
        starts = [found]
        if np.asarray(facts["inliers"], bool).sum() >= _MIN_COMMON:
            scale = np.diag([focal, focal, 1.0])
            normal = np.linalg.inv(scale) @ np.asarray(plane) @ scale
            starts += poselib.motion_from_homography(normal)[0]
        loss = {"loss_type": "CAUCHY", "loss_scale": 0.5 * self.max_error}
        out = []
        for start in starts:
            refined, _ = poselib.refine_relative_pose(a, b, start, camera, camera, loss)
            pose = np.asarray(refined.Rt, np.float64)
            length = np.linalg.norm(pose[:, 3])
            if not np.isfinite(pose).all() or length < 1e-9:
                continue
            pose[:, 3] /= length
            good = self._good(pose, ray_a, ray_b)[0]
            if good.sum() >= _MIN_MATCHES and good.mean() >= 0.5:
                out.append(pose)
        return out

    def _parallax(self, pose: Array, ray_a: Array, ray_b: Array) -> float:
        """Median angle between the two rays of a match, degrees."""
        good, _, angle = self._good(pose, ray_a, ray_b)
        return float(np.degrees(np.median(angle[good])))

    def _good(
        self, pose: Array, ray_a: Array, ray_b: Array
    ) -> tuple[np.ndarray[tuple[int], np.dtype[np.bool_]], Array, Array]:
        rotation, translation = pose[:, :3], pose[:, 3]
        depth, angle = depth_of_first(rotation, translation, ray_a, ray_b)
        error = epipolar_error(rotation, translation, ray_a, ray_b) * self._focal
        in_second = np.column_stack([ray_a, np.ones(len(ray_a))]) @ rotation[2]
        good = (depth > 0) & (depth * in_second + translation[2] > 0) & (error <= self.max_error)
        return good, depth, angle

    def _witnesses(self, first: int, second: int) -> list[tuple[Sighting, Ids]]:
        """Other frames, rather those between, with their matches with the first one."""
        between = list(range(first + 1, second))
        near = sorted(set(range(second)) - {first, *between}, key=lambda i: abs(i - first))
        at = np.linspace(0, len(between) - 1, min(_WITNESSES, len(between))).round().astype(int)
        chosen = [between[k] for k in at] + near[: max(0, _WITNESSES - len(at))]
        one = self.waiting[first]
        return [(self.waiting[i], self._match(one, self.waiting[i])) for i in chosen]

    def _match(self, one: Sighting, other: Sighting) -> Ids:
        key = one.name, other.name
        if key not in self._matches:
            self._matches[key] = match(one, other)
        return self._matches[key]

    def _support(
        self,
        one: Sighting,
        other: Sighting,
        rows: Ids,
        pose: Array,
        witnesses: list[tuple[Sighting, Ids]],
    ) -> tuple[float, float]:
        """How well landmarks of this relative pose fit what others saw, and which share fits.

        The first counts each landmark as 1 less its squared error over the squared limit.
        """
        good, depth, _ = self._good(pose, one.rays[rows[:, 0]], other.rays[rows[:, 1]])
        points = np.full((len(one.keypoints), 3), np.nan)
        at = rows[good, 0]
        points[at] = np.column_stack([one.rays[at], np.ones(len(at))]) * depth[good, None]
        limit = 0.75 * self.max_error
        fit, fitting, total = 0.0, 0, 0
        for witness, pairs in witnesses:
            known = np.isfinite(points[pairs[:, 0], 0])
            if known.sum() < _MIN_COMMON:
                continue
            pixels = witness.keypoints[pairs[known, 1]].astype(np.float64)
            seen = points[pairs[known, 0]]
            total += len(seen)
            found = absolute_pose(self.camera, pixels, seen, limit)
            if found is not None:
                error = reprojection_error(self.camera, pixels, seen, found[0])
                fit += float(np.maximum(1 - (error / limit) ** 2, 0).sum())
                fitting += int((error <= limit).sum())
        return fit, fitting / max(total, 1)


def _alike(first: Array, second: Array) -> bool:
    turn = np.linalg.norm(first[:, :3] - second[:, :3]) / np.sqrt(8)
    way = float(first[:, 3] @ second[:, 3])
    return bool(2 * np.degrees(np.arcsin(min(turn, 1.0))) < 1 and way > np.cos(np.radians(10)))


def match(first: Sighting, second: Sighting) -> Ids:
    """(k, 2) mutual nearest neighbours that pass the ratio test."""
    if len(first.descriptors) < 2 or len(second.descriptors) < 2:
        return np.zeros((0, 2), np.int64)
    index, distance = pm.hamming_search(first.descriptors, second.descriptors, k=2)
    rows = np.flatnonzero(distance[:, 0] < RATIO * distance[:, 1])
    target = index[rows, 0]
    back, _ = pm.hamming_search(second.descriptors[target], first.descriptors, k=1)
    mutual = back[:, 0] == rows
    return np.column_stack([rows[mutual], target[mutual]]).astype(np.int64)


def _turned(rotation: Array, first: Array, second: Array, limit: float) -> float:
    """Share of ray pairs that some rotation alone explains.

    The rotation is fitted robustly: from the given one on, least squares over what fits best.
    """
    a = np.column_stack([first, np.ones(len(first))])
    b = np.column_stack([second, np.ones(len(second))])
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    for _ in range(5):
        off = np.linalg.norm(a @ rotation.T - b, axis=1)
        near = off <= np.median(off)
        u, _, vt = np.linalg.svd(b[near].T @ a[near])
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return float((np.linalg.norm(a @ rotation.T - b, axis=1) <= limit).mean())
