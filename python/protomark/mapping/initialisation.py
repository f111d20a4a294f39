"""Finds the first two frames of a map: a pair with parallax and an unambiguous relative pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protomark.extras import optional
from protomark.geometry.absolute_pose import MAX_ITERATIONS, MIN_ITERATIONS, estimate_pose
from protomark.geometry.bundle import Bundle
from protomark.geometry.camera import Camera
from protomark.geometry.triangulation import depth_of_first, epipolar_error
from protomark.mapping.frame import Array, Frame, Ids
from protomark.tracks.matching import mutual_matches

RATIO = 0.8
# This many matches must agree with the relative pose.
_MIN_MATCHES = 60
# Median angle between the two rays of a match, degrees.
MIN_PARALLAX = 2.0
# If a rotation alone explains this share of the matches, there is no parallax.
_MAX_ROTATED = 0.7
# A pose of each witness must agree with this share of the landmarks that it observes, within three
# quarters of the largest error; and the best relative pose must fit the witnesses better than any
# other by this factor, which is larger with one or two witnesses.
_MIN_SUPPORT = 0.7
_MIN_LEAD = 1.05
_MIN_LEAD_TWO_WITNESSES = 1.2
_MAX_WITNESSES = 4
_MIN_COMMON = 40
_REFINE_STEPS = 10
# Of more waiting frames every second one is dropped; it is retried at the end as a lost frame.
_MAX_WAITING = 40
# A new frame is paired with at most so many waiting ones, from the oldest to the newest.
_MAX_PARTNERS = 10


@dataclass
class TwoViewPose:
    """The relative pose of two frames, the first one at the origin."""

    first: int  # index into `Initialiser.waiting`
    second: int  # index into `Initialiser.waiting`
    pose: Array  # (3, 4) float64, of the second; the translation has length 1


class Initialiser:
    """Collects frames until two of them show the scene from positions far enough apart.

    Two views of a plane fit two relative poses, and views of little depth nearly do. Other waiting
    frames, the witnesses, decide: landmarks of a wrong pose do not project where these see them.
    """

    def __init__(self, camera: Camera, max_error: float) -> None:
        self.camera, self.max_error = camera, max_error
        self.waiting: list[Frame] = []
        self.best_parallax = 0.0
        self._focal = camera.focal_length
        self._matches: dict[tuple[str, str], Ids] = {}

    def push(self, frame: Frame) -> TwoViewPose | None:
        """Pair a new frame with waiting ones, the oldest first; without success it waits, too."""
        self.waiting.append(frame)
        if len(self.waiting) > _MAX_WAITING:
            # The oldest frame stays, as a slow video needs a long baseline.
            del self.waiting[1:-1:2]
            self._matches.clear()
        last = len(self.waiting) - 1
        partners = np.linspace(0, last - 1, min(last, _MAX_PARTNERS)).round().astype(int)
        for first in partners.tolist():
            pose = self._relative_pose(first, last)
            if pose is not None:
                return TwoViewPose(first, last, pose)
        return None

    def _relative_pose(self, first: int, second: int) -> Array | None:
        one, other = self.waiting[first], self.waiting[second]
        rows = self._match(one, other)
        if len(rows) < _MIN_MATCHES:
            return None
        rays = one.rays[rows[:, 0]], other.rays[rows[:, 1]]
        # A cheap test that most pairs of a video fail.
        if _rotated_share(np.eye(3), *rays, self.max_error / self._focal) > _MAX_ROTATED:
            return None
        candidates = self._candidates(one, other, rows)
        if not candidates:
            return None
        parallax = self._parallax(candidates[0], *rays)
        if parallax < MIN_PARALLAX:
            self.best_parallax = max(self.best_parallax, parallax)
            return None
        witnesses = self._witnesses(first, second)
        supports = [self._support(one, other, rows, pose, witnesses) for pose in candidates]
        best = max(supports, key=lambda support: support.score)
        if best.share < _MIN_SUPPORT:
            return None
        parallax = self._parallax(best.pose, *rays)
        self.best_parallax = max(self.best_parallax, parallax)
        if parallax < MIN_PARALLAX:
            return None
        lead = _MIN_LEAD if len(witnesses) > 2 else _MIN_LEAD_TWO_WITNESSES
        for rival in supports:
            if best.score < lead * rival.score and not _same_pose(rival.pose, best.pose):
                return None
        return best.pose

    def _candidates(self, one: Frame, other: Frame, rows: Ids) -> list[Array]:
        """The relative pose that fits best, and those that a planar scene admits."""
        poselib = optional("poselib")
        camera, focal = self.camera.as_dict(), self._focal
        a, b = (f.keypoints[rows[:, k]].astype(np.float64) for k, f in enumerate((one, other)))
        sampling = {"min_iterations": MIN_ITERATIONS, "max_iterations": MAX_ITERATIONS, "seed": 0}
        options = {"max_epipolar_error": self.max_error, **sampling}
        found, facts = poselib.estimate_relative_pose(a, b, camera, camera, options, {})
        inliers = np.asarray(facts["inliers"], bool)
        if inliers.sum() < _MIN_MATCHES or inliers.mean() < 0.5:
            return []
        ray_a, ray_b = one.rays[rows[:, 0]], other.rays[rows[:, 1]]
        pose = np.asarray(found.Rt, np.float64)
        limit = self.max_error / focal
        if _rotated_share(pose[:, :3], ray_a[inliers], ray_b[inliers], limit) > _MAX_ROTATED:
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
            good = self._verify(pose, ray_a, ray_b)[0]
            new = not any(_same_pose(pose, other) for other in out)
            if new and good.sum() >= _MIN_MATCHES and good.mean() >= 0.5:
                out.append(pose)
        return out

    def _parallax(self, pose: Array, ray_a: Array, ray_b: Array) -> float:
        """Median angle between the two rays of a match, degrees."""
        good, _, angle = self._verify(pose, ray_a, ray_b)
        return float(np.degrees(np.median(angle[good])))

    def _verify(
        self, pose: Array, ray_a: Array, ray_b: Array
    ) -> tuple[NDArray[np.bool_], Array, Array]:
        """Whether each match fits a pose, its depth in the first frame, and its angle."""
        rotation, translation = pose[:, :3], pose[:, 3]
        depth, angle = depth_of_first(rotation, translation, ray_a, ray_b)
        error = epipolar_error(rotation, translation, ray_a, ray_b) * self._focal
        in_second = np.column_stack([ray_a, np.ones(len(ray_a))]) @ rotation[2]
        good = (depth > 0) & (depth * in_second + translation[2] > 0) & (error <= self.max_error)
        return good, depth, angle

    def _witnesses(self, first: int, second: int) -> list[tuple[Frame, Ids]]:
        """Further frames, preferably between the two, and their matches with the first one."""
        between = list(range(first + 1, second))
        near = sorted(set(range(second)) - {first, *between}, key=lambda i: abs(i - first))
        at = np.linspace(0, len(between) - 1, min(_MAX_WITNESSES, len(between))).round().astype(int)
        chosen = [between[k] for k in at] + near[: max(0, _MAX_WITNESSES - len(at))]
        one = self.waiting[first]
        return [(self.waiting[i], self._match(one, self.waiting[i])) for i in chosen]

    def _match(self, one: Frame, other: Frame) -> Ids:
        key = one.name, other.name
        if key not in self._matches:
            assert one.descriptors is not None
            assert other.descriptors is not None
            self._matches[key] = mutual_matches(one.descriptors, other.descriptors, RATIO)
        return self._matches[key]

    def _support(
        self,
        one: Frame,
        other: Frame,
        rows: Ids,
        pose: Array,
        witnesses: list[tuple[Frame, Ids]],
    ) -> _Support:
        """How well a relative pose, adjusted together with the witnesses, fits what these see.

        The score counts each landmark as 1 minus its squared error over the squared limit.
        """
        rays = one.rays[rows[:, 0]], other.rays[rows[:, 1]]
        verified, depth, _ = self._verify(pose, *rays)
        # Noise moves what is far away beyond infinity.
        depth = np.where(depth > 0, depth, np.median(depth[verified]))
        good = epipolar_error(pose[:, :3], pose[:, 3], *rays) * self._focal <= self.max_error
        at, count = rows[good, 0], int(good.sum())
        landmark = np.full(len(one.keypoints), -1)
        landmark[at] = np.arange(count)
        points = np.column_stack([one.rays[at], np.ones(count)]) * depth[good, None]
        poses, observed = [np.eye(3, 4), pose], [landmark[at]] * 2
        seen = [one.rays[at], other.rays[rows[good, 1]]]
        limit = 0.75 * self.max_error
        for witness, pairs in witnesses:
            pairs = pairs[landmark[pairs[:, 0]] >= 0]
            if len(pairs) < _MIN_COMMON:
                continue
            pixels, ids = witness.keypoints[pairs[:, 1]].astype(np.float64), landmark[pairs[:, 0]]
            found = estimate_pose(pixels, points[ids], self.camera, limit)
            observed.append(ids)
            seen.append(witness.rays[pairs[:, 1]])
            poses.append(poses[0] if found is None else found.cam_from_world)
        counts = [len(ids) for ids in observed]
        bundle = Bundle(
            poses=np.array(poses),
            moving=np.arange(len(poses)) > 0,
            camera=np.zeros(len(poses), np.int64),
            lenses=np.array([[self._focal, 0.0]]),
            refined=np.zeros(1, bool),
            points=points,
            frame=np.repeat(np.arange(len(poses)), counts),
            point=np.concatenate(observed),
            pixels=self._focal * np.concatenate(seen),
            sigma=np.ones(sum(counts)),
        )
        bundle.adjust(_REFINE_STEPS, 0.5 * self.max_error)
        error = bundle.errors()[bundle.frame > 1]
        length = np.linalg.norm(bundle.poses[1, :, 3])
        refined = np.column_stack([bundle.poses[1, :, :3], bundle.poses[1, :, 3] / length])
        score = float(np.maximum(1 - (error / limit) ** 2, 0).sum())
        return _Support(refined, score, float((error <= limit).mean()) if len(error) else 0.0)


@dataclass
class _Support:
    """How well a relative pose fits the witnesses."""

    pose: Array  # (3, 4) float64, adjusted
    score: float
    share: float  # of landmarks that fit


def _same_pose(first: Array, second: Array) -> bool:
    """Whether rotations differ by less than 1 degree, and translations by less than 10."""
    chord = np.linalg.norm(first[:, :3] - second[:, :3]) / np.sqrt(8)
    cosine = float(first[:, 3] @ second[:, 3])
    return bool(2 * np.degrees(np.arcsin(min(chord, 1.0))) < 1 and cosine > np.cos(np.radians(10)))


def _rotated_share(rotation: Array, first: Array, second: Array, limit: float) -> float:
    """Share of ray pairs that a rotation alone explains.

    Starting at the given one, the rotation is fitted robustly: least squares over the better half.
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
