"""Poses of images in a map of prototypes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.acceptance import Acceptance
from protomark.localization.absolute_pose import FocalLength, check_camera
from protomark.localization.frustum import PosePrior, visible
from protomark.localization.solve import CANDIDATES, Localization, solve
from protomark.matching import MIN_PROBABILITY
from protomark.subset import Subset
from protomark.tracks.features import DESCRIPTORS, Extractor, Features, read_gray
from protomark.tracks.file import Camera
from protomark.upright import SUFFIX, upright_descriptors

# COLMAP's guess where nothing is known of a camera, times the longer side.
_FOCAL_LENGTH = 1.2


class Localizer:
    """Finds where images were taken.

        localizer = pm.Localizer(pm.open("scene.pmk"))
        result = localizer.localize("frame.jpg", camera)
        result.cam_from_world, result.inliers, result.confidence, result.seconds

    Each thread needs one of its own (OpenCV's detectors are not to be shared).

    Args:
        scene: an open or a sealed map whose landmarks have positions.
        max_keypoints: how many keypoints an image keeps.
        min_probability: a match is accepted if it is at least so likely to be right.
        threads: threads to encode and search on.

    Raises:
        ValueError: no landmark of the map has a position, or its encoder was not calibrated.
    """

    def __init__(
        self,
        scene: pm.PrototypeMap | pm.SealedMap,
        *,
        max_keypoints: int = 2000,
        min_probability: float = MIN_PROBABILITY,
        threads: int = 1,
    ) -> None:
        self.scene = scene
        self.max_keypoints = max_keypoints
        self.min_probability = min_probability
        self.threads = threads
        self._ids = scene.ids
        self._positions = scene.positions(self._ids)
        if not np.isfinite(self._positions).all(axis=1).any():
            raise ValueError(
                f"none of the map's {len(self._ids)} landmarks has a position, so no pose can be "
                "found in it: set them with `set_positions`, or build the map from tracks"
            )
        self.acceptance = Acceptance.of(scene.encoder, scene.dim)
        self._extractor: Extractor | None = None

    def localize(
        self,
        image: str | Path | NDArray[np.uint8],
        camera: Camera | None = None,
        prior: PosePrior | None = None,
        *,
        focal_length: FocalLength = "known",
    ) -> Localization:
        """The pose of one image.

        Args:
            image: a file, or (height, width) grey or (height, width, 3) BGR uint8.
            camera: its camera; None: a pinhole whose focal length is estimated.
            prior: roughly where it was taken: only landmarks that it makes visible are searched.
            focal_length: "rough" to have the camera's refined, "unknown" to have it estimated.

        Raises:
            FileNotFoundError, ValueError: the image cannot be read, is not of the camera's size,
                or the map's descriptor is none that this package computes.
        """
        seconds: dict[str, float] = {}
        with _timed(seconds, "features"):
            pixels = read_gray(Path(image)) if isinstance(image, (str, Path)) else _gray(image)
            height, width = pixels.shape
            if camera is not None and (camera.width, camera.height) != (width, height):
                raise ValueError(
                    f"the image has {width} x {height} pixels, its camera {camera.width} x "
                    f"{camera.height}: scale one of them"
                )
            found = self._extract(pixels)
        return self.localize_features(
            found.keypoints,
            found.descriptors,
            camera or guessed_camera(width, height),
            prior,
            focal_length=focal_length if camera is not None else "unknown",
            seconds=seconds,
        )

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
        """The pose of a frame whose keypoints are described already.

        Args:
            keypoints: (n, 2), pixels, the centre of the upper left one at (0.5, 0.5).
            descriptors: (n, bits / 8) uint8, those that the map's encoder takes.
            camera: the frame's camera.
            prior: see `localize`.
            focal_length: see `localize`.
            seconds: what earlier stages took, by name.

        Raises:
            ValueError: lengths differ, descriptors are not the encoder's, or no pose can be found
                for cameras of this model.
        """
        check_camera(camera)
        if len(keypoints) != len(descriptors):
            raise ValueError(f"{len(keypoints)} keypoints, but {len(descriptors)} descriptors")
        seconds = dict(seconds or {})
        with _timed(seconds, "encode"):
            codes = self.scene.encoder.encode(descriptors, self.scene.dim, self.threads)
        with _timed(seconds, "search"):
            searched: pm.PrototypeMap | pm.SealedMap | Subset = self.scene
            if prior is not None:
                searched = Subset(self.scene, self._ids[visible(prior, camera, self._positions)])
            ids, distances = searched.search_codes(codes, k=CANDIDATES, threads=self.threads)
        return solve(
            np.asarray(keypoints, np.float64).reshape(-1, 2),
            camera,
            ids,
            self._positions_of(ids),
            self.acceptance.probability(distances),
            self.min_probability,
            focal_length,
            seconds,
        )

    def _positions_of(self, ids: NDArray[np.int64]) -> NDArray[np.float64]:
        """(...) ids, -1 for none -> (..., 3), NaN where there is no position."""
        where = np.minimum(np.searchsorted(self._ids, ids), len(self._ids) - 1)
        return np.where((ids >= 0)[..., None], self._positions[where], np.nan)

    def _extract(self, image: NDArray[np.uint8]) -> Features:
        takes = self.scene.encoder.descriptor
        if self._extractor is None:
            if takes.removesuffix(SUFFIX) not in DESCRIPTORS:
                raise ValueError(
                    f"the map's encoder takes {takes} descriptors, which OpenCV does not compute: "
                    "describe the keypoints yourself and call localize_features"
                )
            self._extractor = Extractor(takes.removesuffix(SUFFIX), self.max_keypoints)
        found = self._extractor(image)
        if takes.endswith(SUFFIX):
            found.descriptors = upright_descriptors(found.descriptors, found.angles, found.sizes)
        return found


def guessed_camera(width: int, height: int) -> Camera:
    """A pinhole camera as COLMAP guesses it."""
    focal = _FOCAL_LENGTH * max(width, height)
    return Camera("SIMPLE_PINHOLE", width, height, (focal, width / 2, height / 2))


def _gray(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or 0 in image.shape:
        raise ValueError(
            f"an image is (height, width) or (height, width, 3) uint8, not {image.shape} "
            f"{image.dtype}"
        )
    if image.ndim == 2:
        return image
    import cv2

    if image.shape[2] != 3:
        raise ValueError(f"an image has 3 colours, not {image.shape[2]}")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - began
