"""Frames, landmarks and observations of a map in the making, without descriptors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.features.extractor import pixel_size
from protomark.geometry.absolute_pose import reprojection_error
from protomark.geometry.camera import Camera
from protomark.geometry.pose import camera_centers, transform
from protomark.geometry.similarity import Similarity
from protomark.geometry.triangulation import pixel_errors
from protomark.mapping.frame import Array, Frame, Ids
from protomark.mapping.options import MappingOptions

# Descriptors match in views within this angle of the mean direction that a landmark was observed
# from, and at distances that differ by at most this factor.
_MAX_VIEWING_COSINE = np.cos(np.radians(60))
_MAX_SCALE_CHANGE = 2.0
# What a structure has of each landmark.
PER_LANDMARK = ("positions", "directions", "views", "distances", "born")
# Keypoints are at best this accurate (pixels), however small the image.
_MIN_TOLERANCE = 2.5


@dataclass
class Observations:
    """n observations of landmarks."""

    frames: Ids  # (n,) int64, index of the frame
    rows: Ids  # (n,) int64, row of the keypoint in its frame
    landmarks: Ids  # (n,) int64
    poses: Array  # (n, 3, 4) float64
    rays: Array  # (n, 2) float64, undistorted
    focal: Array  # (n,) float64, focal length in pixels
    sigma: Array  # (n,) float64, see `Frame`

    def where(self, keep: Any) -> Observations:
        """The observations for which `keep` (n,) is true."""
        return Observations(*(values[keep] for values in vars(self).values()))


_NOTHING: tuple[NDArray[Any], ...] = (
    *[np.zeros(0, np.int64)] * 3,
    *(np.zeros((0, *shape)) for shape in ((3, 4), (2,), (), ())),
)


@dataclass
class Structure:
    """Frames in the order in which they were registered, and landmarks by id.

    Landmark ids count up from 1 and index the arrays; no id is used twice.
    """

    cameras: dict[int, Camera] = field(default_factory=dict)  # cameras by id
    options: MappingOptions = field(default_factory=MappingOptions)
    frames: list[Frame] = field(default_factory=list)  # frames with a pose
    # (l, 3) float64, NaN for ids of removed landmarks and for id 0.
    positions: Array = field(default_factory=lambda: np.full((1, 3), np.nan))
    # (l, 3) float64, sum of unit vectors from the landmark to its cameras.
    directions: Array = field(default_factory=lambda: np.zeros((1, 3)))
    # (l,) int64, number of these vectors.
    views: Ids = field(default_factory=lambda: np.zeros(1, np.int64))
    # (l, 2) float64, smallest and largest distance of an observing camera.
    distances: Array = field(default_factory=lambda: np.zeros((1, 2)))
    # (l,) int64, number of frames in the map when the landmark was created.
    born: Ids = field(default_factory=lambda: np.zeros(1, np.int64))

    @property
    def existing(self) -> NDArray[np.bool_]:
        """Whether each id (l,) is a landmark."""
        return np.isfinite(self.positions[:, 0])

    @property
    def ids(self) -> Ids:
        """Ids of all landmarks, ascending."""
        return np.flatnonzero(self.existing)

    def focal(self, camera_id: int) -> float:
        """Focal length of a camera in pixels."""
        return self.cameras[camera_id].focal_length

    def tolerance(self, camera_id: int, share: float) -> float:
        """A share of the longer side of a camera's images in pixels, at least `_MIN_TOLERANCE`."""
        camera = self.cameras[camera_id]
        least = _MIN_TOLERANCE * self.pixel(camera_id)
        return max(share * max(camera.width, camera.height), least)

    def max_error(self, camera_id: int) -> float:
        """Largest reprojection error of an observation in pixels."""
        return self.tolerance(camera_id, self.options.max_error)

    def pixel(self, camera_id: int) -> float:
        """See `pixel_size`: keypoints of a camera are so accurate."""
        camera = self.cameras[camera_id]
        return pixel_size((camera.width, camera.height), self.options.max_size)

    def matched(self, frame: Frame, rows: Ids, ids: Ids) -> tuple[Array, Array, Camera]:
        """Pixels (n, 2) of a frame's keypoints, positions (n, 3) of landmarks, and its camera."""
        pixels = frame.keypoints[rows].astype(np.float64)
        return pixels, self.positions[ids], self.cameras[frame.camera_id]

    def median_error(self, pose: Array, frame: Frame, rows: Ids, ids: Ids) -> float:
        """Median distance in pixels of a frame's keypoints from landmarks projected by a pose."""
        return float(np.median(reprojection_error(pose, *self.matched(frame, rows, ids))))

    def codes(self) -> tuple[Ids, NDArray[Any]]:
        """Landmarks (n,) of all observations, and the codes (n, width) of their keypoints."""
        frames = [f for f in self.frames if f.encoded is not None]
        codes = [f.encoded[f.observed] for f in frames if f.encoded is not None]
        return np.concatenate([f.seen for f in frames]), np.concatenate(codes)

    def keyframes(self) -> list[int]:
        """Indices of the keyframes."""
        return [i for i, frame in enumerate(self.frames) if frame.keyframe]

    def create(self, positions: Array) -> Ids:
        """Add landmarks at positions (n, 3); returns their ids (n,)."""
        start, count = len(self.positions), len(positions)
        views, born = (np.full(count, value, np.int64) for value in (0, len(self.frames)))
        distances = np.tile([np.inf, 0.0], (count, 1))
        self.append(positions, np.zeros((count, 3)), views, distances, born)
        return np.arange(start, start + count)

    def append(self, *arrays: NDArray[Any]) -> None:
        """Append what there is of further landmarks, as `PER_LANDMARK` says."""
        for name, array in zip(PER_LANDMARK, arrays, strict=True):
            setattr(self, name, np.concatenate([getattr(self, name), array]))

    def observe(self, frame: Frame, rows: Ids, ids: Ids) -> None:
        """Record that keypoints of a frame (by row) observe landmarks."""
        frame.landmarks[rows] = ids
        self._add_views(camera_centers(frame.pose)[None], ids)

    def _add_views(self, centers: Array, ids: Ids) -> None:
        toward = centers - self.positions[ids]
        distance = np.linalg.norm(toward, axis=1)
        # A frame observes each landmark once, so no id repeats.
        self.directions[ids] += toward / np.maximum(distance, 1e-12)[:, None]
        self.views[ids] += 1
        self.distances[ids, 0] = np.minimum(self.distances[ids, 0], distance)
        self.distances[ids, 1] = np.maximum(self.distances[ids, 1], distance)

    def recompute_views(self) -> None:
        """Recompute directions and distances after poses and positions have moved."""
        self.directions[:], self.views[:] = 0, 0
        self.distances[:] = np.inf, 0.0
        for frame in self.frames:
            self._add_views(camera_centers(frame.pose)[None], frame.seen)

    def move(self, motion: Similarity) -> None:
        """Move frames and landmarks into another world."""
        self.positions = motion(self.positions)
        self.directions = self.directions @ motion.rotation.T
        self.distances = motion.scale * self.distances
        for frame in self.frames:
            frame.pose = motion.move_poses(frame.pose)

    def remove(self, ids: Ids) -> None:
        """Remove landmarks and their observations."""
        self.positions[ids] = np.nan
        removed = np.zeros(len(self.positions), bool)
        removed[ids] = True
        frames, landmarks = self.pairs()
        for i in np.unique(frames[removed[landmarks]]).tolist():
            frame = self.frames[i]
            frame.landmarks[removed[frame.landmarks] & (frame.landmarks >= 0)] = -1

    def merge(self, into: Ids, source: Ids) -> None:
        """Give the observations of each source landmark to the one in `into`."""
        target = np.arange(len(self.positions))
        target[source] = into
        frames, landmarks = self.pairs()
        for i in np.unique(frames[target[landmarks] != landmarks]).tolist():
            frame = self.frames[i]
            seen = frame.landmarks >= 0
            frame.landmarks[seen] = target[frame.landmarks[seen]]
        self.directions[into] += self.directions[source]
        self.views[into] += self.views[source]
        self.distances[into, 0] = np.minimum(self.distances[into, 0], self.distances[source, 0])
        self.distances[into, 1] = np.maximum(self.distances[into, 1], self.distances[source, 1])
        self.positions[source] = np.nan

    def weights(self, pose: Array, ids: Ids) -> Array:
        """Weights (n,) in (0, 1] of landmarks in a pose: the better known a landmark, the larger.

        A weight is the variance of a keypoint over the variance of keypoint and projected landmark
        together. Seen from between its rays, a landmark projects as accurately as a keypoint; the
        further a view is from them, the more of the landmark's error in depth it shows.
        """
        toward = camera_centers(pose) - self.positions[ids]
        toward /= np.maximum(np.linalg.norm(toward, axis=1), 1e-12)[:, None]
        mean = self.directions[ids]
        length = np.maximum(np.linalg.norm(mean, axis=1), 1e-12)
        # These are squares of small angles. Many rays count no more than two with the same spread,
        # as those of frames other than keyframes did not determine the position.
        spread = 2 * (1 - length / np.maximum(self.views[ids], 1))
        off = 2 * (1 - (toward * mean).sum(1) / length)
        spread = np.maximum(spread, 1e-12)
        return np.asarray(2 * spread / (2 * spread + np.maximum(off, 0)))

    def visible(self, pose: Array, camera_id: int, margin: float = 0.0) -> tuple[Ids, Array]:
        """Landmarks (m,) that a camera may recognise from a pose, and their pixels (m, 2)."""
        ids = self.ids
        at = self.positions[ids]
        local = transform(pose, at)
        camera = self.cameras[camera_id]
        if not camera.wide:
            front = local[:, 2] > 0
            ids, at, local = ids[front], at[front], local[front]
            # Beyond the image, distortion is undefined and may bend rays back into it.
            bound = 1.3 * np.array([camera.width, camera.height]) / (2 * self.focal(camera_id))
            inside = (np.abs(local[:, :2] / local[:, 2:]) < bound + 0.3).all(1)
            ids, at, local = ids[inside], at[inside], local[inside]
        toward = camera_centers(pose) - at
        distance = np.linalg.norm(toward, axis=1)
        mean = self.directions[ids]
        cosine = (toward * mean).sum(1) / np.maximum(distance * np.linalg.norm(mean, axis=1), 1e-12)
        near, far = self.distances[ids].T
        fits = cosine > _MAX_VIEWING_COSINE
        fits &= (distance * _MAX_SCALE_CHANGE > near) & (distance < far * _MAX_SCALE_CHANGE)
        ids, local = ids[fits], local[fits]
        pixels = camera.project(local)
        size = np.array([camera.width, camera.height])
        inside = ((pixels > -margin) & (pixels < size + margin)).all(1)
        return ids[inside], pixels[inside]

    def pairs(self, frames: Sequence[int] | None = None) -> tuple[Ids, Ids]:
        """Frame index (n,) and landmark (n,) of each observation of these frames; None: of all."""
        chosen = range(len(self.frames)) if frames is None else frames
        rows = [self.frames[i].landmarks for i in chosen]
        frame = np.repeat(np.array(chosen, np.int64), [len(r) for r in rows])
        landmarks = np.concatenate([np.zeros(0, np.int64), *rows])
        seen = landmarks >= 0
        return frame[seen], landmarks[seen]

    def observations(self, frames: Sequence[int] | None = None) -> Observations:
        """Observations of these frames; None: of all keyframes."""
        parts = [_NOTHING]
        for i in self.keyframes() if frames is None else frames:
            frame, rows = self.frames[i], self.frames[i].observed
            n, focal = len(rows), self.focal(frame.camera_id)
            poses = np.broadcast_to(frame.local_poses(rows), (n, 3, 4))
            seen = np.full(n, i), rows, frame.landmarks[rows]
            parts.append((*seen, poses, frame.rays[rows], np.full(n, focal), frame.sigma[rows]))
        return Observations(*map(np.concatenate, zip(*parts, strict=True)))

    def errors(self, seen: Observations) -> Array:
        """Reprojection errors in pixels of the undistorted image, infinite behind a camera."""
        return pixel_errors(self.positions[seen.landmarks], seen.poses, seen.rays, seen.focal)

    def counts(self, keyframes_only: bool = True) -> Ids:
        """Number (l,) of keyframes, or of all frames, that observe each landmark."""
        _, landmarks = self.pairs(self.keyframes() if keyframes_only else None)
        return np.bincount(landmarks, minlength=len(self.positions))

    def set_camera(self, camera_id: int, camera: Camera) -> None:
        """Replace a camera, and the rays of its frames with it."""
        self.cameras[camera_id] = camera
        for frame in self.frames:
            if frame.camera_id == camera_id:
                frame.rays, frame.turns = camera.local_rays(frame.keypoints)
