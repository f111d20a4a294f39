"""Finds the first two frames of a map: a pair with parallax and an unambiguous relative pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.absolute_pose import estimate_pose
from protomark.geometry.bundle import Bundle
from protomark.geometry.pose import relative_pose, transform
from protomark.geometry.triangulation import depth_of_first, epipolar_error
from protomark.geometry.two_views import estimate_relative_pose, planar_poses
from protomark.mapping.frame import Array, Frame, Ids
from protomark.mapping.structure import Structure
from protomark.tracks.matching import mutual_matches

RATIO = 0.8
# This many matches must agree with the relative pose.
_MIN_MATCHES = 60
# Angle between the two rays of a match, degrees: the median, and for wide cameras, which look ahead
# as well as aside, the upper quartile.
MIN_PARALLAX = 2.0
_PARALLAX_QUANTILE, _WIDE_PARALLAX_QUANTILE = 0.5, 0.75
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

    def __init__(self, structure: Structure) -> None:
        self._structure = structure
        self.waiting: list[Frame] = []
        self.best_parallax = 0.0
        self._use(next(iter(structure.cameras)))
        self._matches: dict[tuple[str, str], Ids] = {}

    def _use(self, camera_id: int) -> None:
        """Judge frames of this camera."""
        self.camera = self._structure.cameras[camera_id]
        self.max_error = self._structure.max_error(camera_id)
        self._focal = self.camera.focal_length

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
        if one.camera_id != other.camera_id:
            return None
        self._use(one.camera_id)
        rows = self._match(one, other)
        if len(rows) < _MIN_MATCHES:
            return None
        # A cheap test that most pairs of a video fail.
        if self._rotated_share(np.eye(3), one, other, rows) > _MAX_ROTATED:
            return None
        candidates = self._candidates(one, other, rows)
        if not candidates:
            return None
        parallax = self._parallax(candidates[0], one, other, rows)
        if parallax < MIN_PARALLAX:
            self.best_parallax = max(self.best_parallax, parallax)
            return None
        witnesses = self._witnesses(first, second)
        supports = [self._support(one, other, rows, pose, witnesses) for pose in candidates]
        best = max(supports, key=lambda support: support.score)
        if best.share < _MIN_SUPPORT:
            return None
        parallax = self._parallax(best.pose, one, other, rows)
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
        camera, error = self.camera, self.max_error
        a, b = (f.keypoints[rows[:, k]].astype(np.float64) for k, f in enumerate((one, other)))
        found, inliers = estimate_relative_pose(a, b, camera, error)
        if inliers.sum() < _MIN_MATCHES or inliers.mean() < 0.5:
            return []
        if self._rotated_share(found[:, :3], one, other, rows[inliers]) > _MAX_ROTATED:
            return []
        out: list[Array] = []
        for start in (found, *planar_poses(a, b, camera, error, _MIN_COMMON)):
            length = np.linalg.norm(start[:, 3])
            if not np.isfinite(start).all() or length < 1e-9:
                continue
            pose = np.column_stack([start[:, :3], start[:, 3] / length])
            good = self._verify(pose, one, other, rows)[0]
            new = not any(_same_pose(pose, other) for other in out)
            if new and good.sum() >= _MIN_MATCHES and good.mean() >= 0.5:
                out.append(pose)
        return out

    def _rotated_share(self, rotation: Array, one: Frame, other: Frame, rows: Ids) -> float:
        """Share of matches that a rotation near the given one explains."""
        a, b = one.directions(rows[:, 0]), other.directions(rows[:, 1])
        return _rotated_share(rotation, a, b, self.max_error / self._focal)

    def _parallax(self, pose: Array, one: Frame, other: Frame, rows: Ids) -> float:
        """Typical angle between the two rays of a match, degrees."""
        good, _, angle, _ = self._verify(pose, one, other, rows)
        quantile = _WIDE_PARALLAX_QUANTILE if self.camera.wide else _PARALLAX_QUANTILE
        return float(np.degrees(np.quantile(angle[good], quantile)))

    def _verify(
        self, pose: Array, one: Frame, other: Frame, rows: Ids
    ) -> tuple[NDArray[np.bool_], Array, Array, NDArray[np.bool_]]:
        """Whether each match fits a pose, its depth in the first frame, and its angle.

        The last array tells whether it lies near the epipolar line, maybe behind a camera.
        """
        one, other, (a, b) = one.at(np.eye(3, 4)), other.at(pose), rows.T
        relative = relative_pose(one.local_poses(a), other.local_poses(b))
        rays = one.rays[a], other.rays[b]
        depth, angle = depth_of_first(*relative, *rays)
        near = epipolar_error(*relative, *rays) * self._focal <= self.max_error
        in_second = transform(other.local_poses(b), one.points(a, depth))[:, 2]
        return (depth > 0) & (in_second > 0) & near, depth, angle, near

    def _witnesses(self, first: int, second: int) -> list[tuple[Frame, Ids]]:
        """Further frames, preferably between the two, and their matches with the first one."""
        one = self.waiting[first]
        same = [i for i in range(second) if self.waiting[i].camera_id == one.camera_id]
        between = [i for i in same if i > first]
        near = sorted({*same} - {first, *between}, key=lambda i: abs(i - first))
        at = np.linspace(0, len(between) - 1, min(_MAX_WITNESSES, len(between))).round().astype(int)
        chosen = [between[k] for k in at] + near[: max(0, _MAX_WITNESSES - len(at))]
        return [(self.waiting[i], self._match(one, self.waiting[i])) for i in chosen]

    def _match(self, one: Frame, other: Frame) -> Ids:
        key = one.name, other.name
        if key not in self._matches:
            assert one.descriptors is not None
            assert other.descriptors is not None
            self._matches[key] = mutual_matches(
                one.descriptors, other.descriptors, RATIO, self._structure.options.kind
            )
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
        verified, depth, _, good = self._verify(pose, one, other, rows)
        # Noise moves what is far away beyond infinity.
        depth = np.where(depth > 0, depth, np.median(depth[verified]))
        at, count = rows[good, 0], int(good.sum())
        landmark = np.full(len(one.keypoints), -1)
        landmark[at] = np.arange(count)
        points = one.at(np.eye(3, 4)).points(at, depth[good])
        poses, observed = [np.eye(3, 4), pose], [landmark[at]] * 2
        seen = [(one, at), (other, rows[good, 1])]
        limit = 0.75 * self.max_error
        for witness, pairs in witnesses:
            pairs = pairs[landmark[pairs[:, 0]] >= 0]
            if len(pairs) < _MIN_COMMON:
                continue
            pixels, ids = witness.keypoints[pairs[:, 1]].astype(np.float64), landmark[pairs[:, 0]]
            found = estimate_pose(pixels, points[ids], self.camera, limit)
            observed.append(ids)
            seen.append((witness, pairs[:, 1]))
            poses.append(poses[0] if found is None else found.cam_from_world)
        counts = [len(ids) for ids in observed]
        turns = [f.turns[r] for f, r in seen if f.turns is not None]
        bundle = Bundle(
            poses=np.array(poses),
            moving=np.arange(len(poses)) > 0,
            camera=np.zeros(len(poses), np.int64),
            lenses=np.array([[self._focal, 0.0]]),
            refined=np.zeros((1, 2), bool),
            points=points,
            frame=np.repeat(np.arange(len(poses)), counts),
            point=np.concatenate(observed),
            pixels=self._focal * np.concatenate([frame.rays[r] for frame, r in seen]),
            sigma=np.ones(sum(counts)),
            turns=np.concatenate(turns) if turns else None,
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
    """Share of pairs of unit vectors that a rotation alone explains.

    Starting at the given one, the rotation is fitted robustly: least squares over the better half.
    """
    for _ in range(5):
        off = np.linalg.norm(first @ rotation.T - second, axis=1)
        near = off <= np.median(off)
        u, _, vt = np.linalg.svd(second[near].T @ first[near])
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return float((np.linalg.norm(first @ rotation.T - second, axis=1) <= limit).mean())
