"""Localizes an image in a map: the image goes in, its pose comes out."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.features.descriptors import DESCRIPTORS
from protomark.features.extractor import MAX_SIZE, Extractor, Features, described_keypoints
from protomark.features.images import read_gray, to_gray
from protomark.features.upright import SUFFIX, upright_descriptors
from protomark.geometry.absolute_pose import FocalLength
from protomark.geometry.camera import Camera
from protomark.geometry.camera_files import read_cameras
from protomark.localization.prior import PosePrior, visible
from protomark.localization.shared_camera import check_shared_cameras
from protomark.localization.solve import (
    CANDIDATES,
    Candidates,
    Localization,
    solve_place,
    solve_pose,
)
from protomark.maps.cameras import map_cameras
from protomark.maps.origin import map_detector
from protomark.maps.places import map_places
from protomark.maps.sharded_map import ShardedMap, open_scene
from protomark.matching import MIN_PROBABILITY
from protomark.threads import available_threads, parallel_map

Scene = pm.PrototypeMap | pm.SealedMap | ShardedMap
# With more keypoints outside the image they are not pixels (x, y).
_MAX_OUTSIDE = 0.01
# In place of a camera: have it estimated, although the map has one.
ESTIMATE = "estimate"


class Localizer:
    """Finds where images were taken in a map.

        localizer = pm.Localizer("kitchen")
        pose = localizer.localize("frame.jpg")
        pose.cam_from_world, pose.covariance, pose.inliers, pose.confidence

    A sealed map stays on disk: a search reads what it touches, and the positions of what it found.
    Threads may share a localizer.

    Args:
        scene: a learning, sealed or sharded map whose landmarks have positions, its file, or its
            folder.
        max_keypoints: limit on keypoints per image: the strongest, spread over the image; None: as
            many as an image of the map had, if the map knows, or 2000.
        max_size: images whose longer side has more pixels are reduced to it before detection.
        min_probability: smallest probability of an accepted match, in [0, 1].
        recall: in a map with an index, the share of nearest landmarks that an approximate search
            finds, in (0, 1]; None: the search is exact.
        threads: threads to encode and search on.

    Raises:
        FileNotFoundError, FileError: there is no such map, or it is broken.
        ValueError: no landmark of the map has a position, its encoder was not calibrated, or
            `recall` does not fit the map.
    """

    def __init__(
        self,
        scene: Scene | str | Path,
        *,
        max_keypoints: int | None = None,
        max_size: int = MAX_SIZE,
        min_probability: float = MIN_PROBABILITY,
        recall: float | None = None,
        threads: int = 1,
    ) -> None:
        self.scene = open_scene(scene) if isinstance(scene, (str, Path)) else scene
        self.max_keypoints, self.max_size = max_keypoints, max_size
        self.min_probability = min_probability
        self.recall = recall
        self.threads = threads
        if not _has_positions(self.scene):
            raise ValueError(
                f"none of the map's {len(self.scene)} landmarks has a position, so images cannot "
                "be localized in it: build or seal the map with positions (in Python: "
                "set_positions)"
            )
        if recall is not None:
            self.scene.nprobe(recall)  # an error here names what does not fit
        self.cameras = map_cameras(self.scene)
        self.places = map_places(self.scene.metadata)
        tuned = not isinstance(self.scene, pm.PrototypeMap) and self.scene.tuned
        self.calibration = self.scene.encoder.match_calibration(self.scene.dim, tuned)

    def localize(
        self,
        image: str | Path | NDArray[np.uint8],
        camera: Camera | Any | str | None = None,
        prior: PosePrior | None = None,
        *,
        focal_length: FocalLength = "known",
    ) -> Localization:
        """Find the pose of an image.

        Args:
            image: a file, a PIL image, or a (height, width) grey or (height, width, 3) BGR uint8
                array.
            camera: its camera, a `pycolmap.Camera`, or what `--camera` takes: the camera written
                out as "MODEL:PARAMETERS", a cameras.txt or a folder with a COLMAP model. None: the
                camera that the map was made with, if that has the image's size. "estimate", or None
                if the map has no such camera: a pinhole camera whose focal length is estimated.
            prior: a rough pose; only landmarks that are visible from near it are searched.
            focal_length: "known", "rough" to have it refined, or "unknown" to have it estimated.

        Returns:
            The pose, with its covariance, confidence and inliers, or the reason why there is none.

        Raises:
            FileNotFoundError, ValueError: the image cannot be read or is not of the camera's size,
                or OpenCV does not compute the map's descriptor.
        """
        began = time.perf_counter()
        gray = _gray(image)
        height, width = gray.shape
        if camera is None:
            camera = self.map_camera(width, height)
        elif isinstance(camera, str):
            name = str(image) if isinstance(image, (str, Path)) else ""
            given = None if camera == ESTIMATE else read_cameras(camera).for_images([name])
            camera = given.find(name, width, height) if given else None
        elif not isinstance(camera, Camera):
            camera = Camera.from_colmap(camera)
        if camera is None:
            camera, focal_length = Camera.guess(width, height), "unknown"
        camera = camera.sized(width, height)
        if (camera.width, camera.height) != (width, height):
            raise ValueError(
                f"the image has {width} x {height} pixels, but its camera {camera.width} x "
                f"{camera.height}: scale one of them"
            )
        features = self._extract(gray)
        return self.localize_features(
            features.keypoints,
            features.descriptors,
            camera,
            prior,
            focal_length=focal_length,
            seconds={"features": time.perf_counter() - began},
        )

    def localize_many(
        self,
        images: Iterable[str | Path | NDArray[np.uint8]],
        camera: Camera | str | None = None,
        *,
        focal_length: FocalLength = "known",
        threads: int = 0,
    ) -> list[Localization]:
        """The poses of several images, as `localize` finds each, on several threads.

        If they agree on another focal length than their camera's, a warning names that; poses that
        it moves by more than 5 % of the depth get a confidence of 0.

        Args:
            images: files or arrays.
            camera: the camera of all of them, see `localize`.
            focal_length: see `localize`.
            threads: images at a time; 0: one per core.

        Raises:
            FileNotFoundError, ValueError: see `localize`; the first image with an error ends it.
        """
        return check_shared_cameras(
            parallel_map(
                lambda image: self.localize(image, camera, focal_length=focal_length),
                list(images),
                threads or available_threads(),
            )
        )

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "a Localizer cannot be pickled or copied: give each process the map's path and make "
            "one there; threads can share one"
        )

    def map_camera(self, width: int, height: int) -> Camera | None:
        """The camera that the map was made with, if it has one of this size and no other."""
        fitting = self.cameras.of_size(width, height)
        return fitting[0] if len(fitting) == 1 else None

    def localize_features(
        self,
        keypoints: NDArray[np.floating],
        descriptors: NDArray[np.uint8],
        camera: Camera,
        prior: PosePrior | None = None,
        *,
        focal_length: FocalLength = "known",
        seconds: dict[str, float] | None = None,
    ) -> Localization:
        """Find the pose of a frame from its keypoints and descriptors.

        Args:
            keypoints: (n, 2) pixels; the centre of the upper left pixel is (0.5, 0.5).
            descriptors: (n, bytes) uint8, or (n, numbers) float32, as the map's encoder takes them.
            camera: the frame's camera.
            prior: see `localize`.
            focal_length: see `localize`.
            seconds: seconds of earlier stages by name, to be included in the result.

        Returns:
            See `localize`.

        Raises:
            ValueError: the lengths differ, keypoints lie outside the image, the encoder takes other
                descriptors, or there is no such camera.
        """
        camera.check_lens()
        if descriptors is None:  # what OpenCV computes for no keypoints
            descriptors = np.zeros((0, self.scene.encoder.bytes), np.uint8)
        if len(keypoints) != len(descriptors):
            raise ValueError(f"{len(keypoints)} keypoints, but {len(descriptors)} descriptors")
        _check_pixels(np.asarray(keypoints), camera)
        stages = dict(seconds or {})
        # Shards may come and go, but not between a search and the positions of what it found.
        scene = self.scene.snapshot() if isinstance(self.scene, ShardedMap) else self.scene
        with _timed(stages, "encode"):
            codes = scene.encoder.encode(descriptors, scene.dim, self.threads)
        with _timed(stages, "search"):
            among = None
            if prior is not None:
                among = self._visible(scene, prior, camera)
            ids, distances = scene.search_codes(
                codes, k=CANDIDATES, threads=self.threads, recall=self.recall, among=among
            )
        with _timed(stages, "pose"):
            candidates = Candidates(
                np.asarray(keypoints, np.float64).reshape(-1, 2),
                ids,
                _positions_of(scene, ids),
                self.calibration.probability(distances),
            )
            of_map = any(camera.resembles(c) for c in self.cameras.cameras)
            request = (camera, self.min_probability, focal_length, of_map)
            if self.places:
                result = solve_place(candidates, self.places, *request)
            else:
                result = solve_pose(candidates, *request)
        return replace(result, seconds={**stages, "total": sum(stages.values())})

    def _visible(self, scene: Scene, prior: PosePrior, camera: Camera) -> NDArray[np.int64]:
        """Ids of the landmarks that are visible from near a pose."""
        if isinstance(scene, ShardedMap):

            def test(positions: NDArray[np.float64], off: float) -> NDArray[np.bool_]:
                # What is seen there is seen here from a camera that is moved by as much.
                return visible(replace(prior, distance=prior.distance + off), camera, positions)

            return scene.visible(test)
        landmarks, positions = self._all_positions
        return landmarks[visible(prior, camera, positions)]

    @cached_property
    def _all_positions(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Ids and positions of all landmarks, which only a prior needs."""
        ids = self.scene.ids
        return ids, self.scene.positions(ids)

    @cached_property
    def _extractor(self) -> Extractor:
        descriptor = self.scene.encoder.descriptor
        plain = descriptor.removesuffix(SUFFIX)
        if plain not in DESCRIPTORS:
            raise ValueError(
                f"the map's encoder takes {descriptor} descriptors, which are not "
                "computed here: describe the keypoints yourself (in Python: localize_features)"
            )
        detector, size = map_detector(self.scene), self.max_size
        if detector:  # of a program that describes images at their own size
            sides = [max(c.width, c.height) for c in self.cameras.cameras]
            size = min([size, max(sides, default=size)])
        limit = self.max_keypoints
        limit = described_keypoints(detector) if limit is None else limit
        return Extractor(plain, limit, size, detector)

    def _extract(self, image: NDArray[np.uint8]) -> Features:
        features = self._extractor(image)
        if self.scene.encoder.descriptor.endswith(SUFFIX):
            features.descriptors = upright_descriptors(
                features.descriptors, features.angles, features.sizes
            )
        return features


def _gray(image: Any) -> NDArray[np.uint8]:
    if isinstance(image, (str, Path)):
        return read_gray(Path(image))
    if image is None:
        raise ValueError(
            "the image is None, as cv2.imread returns it for a file that it can't read"
        )
    if hasattr(image, "convert"):  # PIL
        image = np.asarray(image.convert("L"))
    if np.ndim(image) == 3 and np.shape(image)[2] == 1:
        image = image[:, :, 0]
    return to_gray(image)


def _check_pixels(keypoints: NDArray[np.floating], camera: Camera) -> None:
    if not len(keypoints):
        return
    size = (camera.width, camera.height)
    outside = ((keypoints < -1) | (keypoints > np.add(size, 1))).any(1).mean()
    if outside > _MAX_OUTSIDE or (len(keypoints) > 1 and np.ptp(keypoints, axis=0).max() <= 1):
        raise ValueError(
            f"keypoints are (x, y) in pixels of an image of {size[0]} x {size[1]}, but these reach "
            f"from {keypoints.min(0)} to {keypoints.max(0)}: normalised, or (row, column)?"
        )


def _positions_of(scene: Scene, ids: NDArray[np.int64]) -> NDArray[np.float64]:
    """Positions (..., 3) of ids (...), NaN where the id is -1 or has no position."""
    positions = np.full((*ids.shape, 3), np.nan)
    found = ids >= 0
    positions[found] = scene.positions(ids[found])
    return positions


def _has_positions(scene: Scene) -> bool:
    # To look at all of a sealed map would read it whole; its landmarks have positions or none does.
    if isinstance(scene, pm.SealedMap):
        return scene.position_bits > 0
    return bool(scene.summary()["landmarks_with_position"])


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - began
