"""Frames, landmarks and observations of a map in the making; no descriptors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.localization.absolute_pose import centre
from protomark.tracks.colmap import focal_length, project, rays
from protomark.tracks.file import Camera
from protomark.tracks.geometry import residuals

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

# A landmark is looked for from at most this angle off the mean of the directions that it was seen
# from, and at distances changed by at most this factor: descriptors do not bear more.
_MAX_VIEWING_COSINE = np.cos(np.radians(60))
_MAX_SCALE_CHANGE = 2.0
# Keypoints are not better than this, however small the image.
_MIN_PIXELS = 2.5


@dataclass
class Frame:
    """A frame with a pose.

    Attributes:
        index: place in its input, from 0.
        name: image name, unique in the map.
        time: seconds, or the index where no times are known.
        camera_id: its camera.
        pose: (3, 4) float64, cam_from_world.
        keypoints: (n, 2) float32, pixels; those without a landmark go when the window moves on.
        landmarks: (n,) int64, landmark that a keypoint sees, -1 for none.
        rays: (n, 2) float64, undistorted.
        keyframe: whether its observations take part in bundle adjustment.
        descriptors: (n, bytes) uint8, None outside of the window.
        encoded: (n, width), the same as the memory compares them; None outside of the window.
    """

    index: int
    name: str
    time: float
    camera_id: int
    pose: Array
    keypoints: NDArray[np.float32]
    landmarks: Ids
    rays: Array
    keyframe: bool = True
    descriptors: NDArray[np.uint8] | None = None
    encoded: NDArray[Any] | None = None

    @property
    def observed(self) -> Ids:
        """Rows of the keypoints that see a landmark."""
        return np.flatnonzero(self.landmarks >= 0)

    @property
    def seen(self) -> Ids:
        """Their landmarks."""
        return self.landmarks[self.landmarks >= 0]

    def forget(self) -> None:
        """Throw descriptors away, and keypoints that see nothing."""
        rows = self.observed
        self.keypoints, self.rays = self.keypoints[rows], self.rays[rows]
        self.landmarks = self.landmarks[rows]
        self.descriptors = self.encoded = None


@dataclass
class Observations:
    """n observations, all keyframes' or some's.

    Attributes:
        frames: (n,) int64, place in the list of frames.
        rows: (n,) int64, keypoint.
        landmarks: (n,) int64.
        poses: (n, 3, 4) float64.
        rays: (n, 2) float64.
        focal: (n,) float64, pixels.
    """

    frames: Ids
    rows: Ids
    landmarks: Ids
    poses: Array
    rays: Array
    focal: Array

    def where(self, keep: Any) -> Observations:
        """Those for which `keep` is true, or in the order of indices."""
        return Observations(
            *(
                getattr(self, name)[keep]
                for name in ("frames", "rows", "landmarks", "poses", "rays", "focal")
            )
        )


@dataclass
class Structure:
    """Frames in the order in which they were registered, and landmarks by id.

    Landmark ids count up from 1 and are rows of the arrays; an id is never used again.

    Attributes:
        cameras: camera id -> camera.
        frames: frames with a pose.
        positions: (l, 3) float64, NaN for an id that is no landmark (any more).
        directions: (l, 3) float64, sum of unit vectors from the landmark to those who saw it.
        looks: (l,) int64, how many vectors these are.
        distances: (l, 2) float64, least and largest distance from which it was seen.
        born: (l,) int64, number of frames when the landmark was made.
    """

    cameras: dict[int, Camera] = field(default_factory=dict)
    frames: list[Frame] = field(default_factory=list)
    positions: Array = field(default_factory=lambda: np.full((1, 3), np.nan))
    directions: Array = field(default_factory=lambda: np.zeros((1, 3)))
    looks: Ids = field(default_factory=lambda: np.zeros(1, np.int64))
    distances: Array = field(default_factory=lambda: np.zeros((1, 2)))
    born: Ids = field(default_factory=lambda: np.zeros(1, np.int64))

    @property
    def alive(self) -> NDArray[np.bool_]:
        """(l,) which ids are landmarks."""
        return np.isfinite(self.positions[:, 0])

    @property
    def ids(self) -> Ids:
        """Ids of all landmarks, ascending."""
        return np.flatnonzero(self.alive)

    def focal(self, camera_id: int) -> float:
        """Focal length of a camera in pixels."""
        return focal_length(self.cameras[camera_id])

    def tolerance(self, camera_id: int, share: float) -> float:
        """A share of the longer side of a camera's images, in pixels, at least `_MIN_PIXELS`."""
        camera = self.cameras[camera_id]
        return max(share * max(camera.width, camera.height), _MIN_PIXELS)

    def keyframes(self) -> list[int]:
        """Places of the keyframes in the list of frames."""
        return [i for i, frame in enumerate(self.frames) if frame.keyframe]

    def create(self, positions: Array) -> Ids:
        """New landmarks at positions (n, 3); their ids."""
        start, many = len(self.positions), len(positions)
        self.positions = np.concatenate([self.positions, positions])
        self.directions = np.concatenate([self.directions, np.zeros((many, 3))])
        self.looks = np.concatenate([self.looks, np.zeros(many, np.int64)])
        self.distances = np.concatenate([self.distances, np.tile([np.inf, 0.0], (many, 1))])
        self.born = np.concatenate([self.born, np.full(many, len(self.frames), np.int64)])
        return np.arange(start, start + many)

    def observe(self, frame: Frame, rows: Ids, ids: Ids) -> None:
        """Let keypoints of a frame see landmarks."""
        frame.landmarks[rows] = ids
        self._look(centre(frame.pose)[None], ids)

    def _look(self, centers: Array, ids: Ids) -> None:
        toward = centers - self.positions[ids]
        distance = np.linalg.norm(toward, axis=1)
        # A frame sees a landmark once: no id is here twice.
        self.directions[ids] += toward / np.maximum(distance, 1e-12)[:, None]
        self.looks[ids] += 1
        self.distances[ids, 0] = np.minimum(self.distances[ids, 0], distance)
        self.distances[ids, 1] = np.maximum(self.distances[ids, 1], distance)

    def look_again(self) -> None:
        """Directions and distances anew, after poses and positions have moved."""
        self.directions[:], self.looks[:] = 0, 0
        self.distances[:] = np.inf, 0.0
        for frame in self.frames:
            self._look(centre(frame.pose)[None], frame.seen)

    def discard(self, ids: Ids) -> None:
        """Take landmarks away, and all that saw them."""
        self.positions[ids] = np.nan
        gone = np.zeros(len(self.positions), bool)
        gone[ids] = True
        places, landmarks = self.pairs()
        for i in np.unique(places[gone[landmarks]]).tolist():
            frame = self.frames[i]
            frame.landmarks[gone[frame.landmarks] & (frame.landmarks >= 0)] = -1

    def merge(self, into: Ids, source: Ids) -> None:
        """Give what saw each source landmark to the one in `into`; the sources are gone."""
        target = np.arange(len(self.positions))
        target[source] = into
        places, landmarks = self.pairs()
        for i in np.unique(places[target[landmarks] != landmarks]).tolist():
            frame = self.frames[i]
            seen = frame.landmarks >= 0
            frame.landmarks[seen] = target[frame.landmarks[seen]]
        self.directions[into] += self.directions[source]
        self.looks[into] += self.looks[source]
        self.distances[into, 0] = np.minimum(self.distances[into, 0], self.distances[source, 0])
        self.distances[into, 1] = np.maximum(self.distances[into, 1], self.distances[source, 1])
        self.positions[source] = np.nan

    def certainty(self, pose: Array, ids: Ids) -> Array:
        """(n,) how much less certain than a keypoint it is where a pose sees landmarks, in (0, 1].

        The variance of the one over that of both together. Rays that spread by an angle fix a
        landmark as well as a keypoint where it is seen from between them; the further from them it
        is looked at, the more of the error of its depth shows.
        """
        toward = centre(pose) - self.positions[ids]
        toward /= np.maximum(np.linalg.norm(toward, axis=1), 1e-12)[:, None]
        mean = self.directions[ids]
        length = np.maximum(np.linalg.norm(mean, axis=1), 1e-12)
        # Squares of small angles. Of many rays no more is taken for granted than of two that spread
        # as much: those of frames that are no keyframes did not fix the landmark.
        spread = 2 * (1 - length / np.maximum(self.looks[ids], 1))
        off = 2 * (1 - (toward * mean).sum(1) / length)
        spread = np.maximum(spread, 1e-12)
        return np.asarray(2 * spread / (2 * spread + np.maximum(off, 0)))

    def visible(self, pose: Array, camera_id: int, margin: float = 0.0) -> tuple[Ids, Array]:
        """Landmarks (m,) that a camera at a pose may recognise, and where they project, pixels."""
        ids = self.ids
        at = self.positions[ids]
        local = at @ pose[:, :3].T + pose[:, 3]
        front = local[:, 2] > 0
        ids, at, local = ids[front], at[front], local[front]
        camera = self.cameras[camera_id]
        # Distortion is only defined within the image: rays that a pinhole sends far out may bend
        # back into it.
        bound = 1.3 * np.array([camera.width, camera.height]) / (2 * self.focal(camera_id))
        inside = (np.abs(local[:, :2] / local[:, 2:]) < bound + 0.3).all(1)
        ids, at, local = ids[inside], at[inside], local[inside]
        toward = centre(pose) - at
        distance = np.linalg.norm(toward, axis=1)
        mean = self.directions[ids]
        cosine = (toward * mean).sum(1) / np.maximum(distance * np.linalg.norm(mean, axis=1), 1e-12)
        near, far = self.distances[ids].T
        fits = cosine > _MAX_VIEWING_COSINE
        fits &= (distance * _MAX_SCALE_CHANGE > near) & (distance < far * _MAX_SCALE_CHANGE)
        ids, local = ids[fits], local[fits]
        pixels = project(camera, local)
        size = np.array([camera.width, camera.height])
        inside = ((pixels > -margin) & (pixels < size + margin)).all(1)
        return ids[inside], pixels[inside]

    def pairs(self, frames: Sequence[int] | None = None) -> tuple[Ids, Ids]:
        """Place of the frame and landmark (n,) of each observation, of some frames or all."""
        chosen = range(len(self.frames)) if frames is None else frames
        rows = [self.frames[i].landmarks for i in chosen]
        places = np.repeat(np.array(chosen, np.int64), [len(r) for r in rows])
        landmarks = np.concatenate([np.zeros(0, np.int64), *rows])
        seen = landmarks >= 0
        return places[seen], landmarks[seen]

    def observations(self, frames: Sequence[int] | None = None) -> Observations:
        """All observations of some frames (places in the list), or of all keyframes."""
        chosen = self.keyframes() if frames is None else list(frames)
        rows = [self.frames[i].observed for i in chosen]
        counts = [len(r) for r in rows]
        pick = [(self.frames[i], r) for i, r in zip(chosen, rows, strict=True)]
        poses = np.array([f.pose for f, _ in pick]).reshape(-1, 3, 4)
        focal = np.array([self.focal(f.camera_id) for f, _ in pick])
        return Observations(
            np.repeat(np.array(chosen, np.int64), counts),
            np.concatenate([np.zeros(0, np.int64), *rows]),
            np.concatenate([np.zeros(0, np.int64), *(f.landmarks[r] for f, r in pick)]),
            np.repeat(poses, counts, axis=0),
            np.concatenate([np.zeros((0, 2)), *(f.rays[r] for f, r in pick)]),
            np.repeat(focal, counts),
        )

    def errors(self, seen: Observations) -> Array:
        """Reprojection errors in pixels of the undistorted image, infinite behind a camera."""
        difference, depth = residuals(self.positions[seen.landmarks], seen.poses, seen.rays)
        error = np.linalg.norm(difference, axis=1) * seen.focal
        return np.where((depth > 0) & np.isfinite(error), error, np.inf)

    def counts(self, keyframes_only: bool = True) -> Ids:
        """(l,) how many frames see each id."""
        _, landmarks = self.pairs(self.keyframes() if keyframes_only else None)
        return np.bincount(landmarks, minlength=len(self.positions))

    def set_camera(self, camera_id: int, camera: Camera) -> None:
        """Change a camera's parameters; rays of its frames follow."""
        self.cameras[camera_id] = camera
        for frame in self.frames:
            if frame.camera_id == camera_id:
                frame.rays = rays(camera, frame.keypoints)
