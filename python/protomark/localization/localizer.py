"""Localizes an image in a map: the image goes in, its pose comes out."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.features.descriptors import DESCRIPTORS
from protomark.features.extractor import Extractor, Features
from protomark.features.images import read_gray, to_gray
from protomark.features.upright import SUFFIX, upright_descriptors
from protomark.geometry.absolute_pose import FocalLength, check_pose_model
from protomark.geometry.camera import Camera
from protomark.localization.prior import PosePrior, visible
from protomark.localization.solve import CANDIDATES, Candidates, Localization, solve_pose
from protomark.maps.open import open_map
from protomark.match_calibration import MatchCalibration
from protomark.matching import MIN_PROBABILITY
from protomark.subset import Subset


class Localizer:
    """Finds where images were taken in a map.

        localizer = pm.Localizer("scene.pmk")
        pose = localizer.localize("frame.jpg", "PINHOLE:525,525,320,240")
        pose.cam_from_world, pose.inliers, pose.confidence, pose.seconds

    Threads cannot share a localizer, as OpenCV's detectors are not thread-safe.

    Args:
        scene: a learning or a sealed map whose landmarks have positions, its file, or the folder
            that `protomark map` wrote.
        max_keypoints: limit on keypoints per image: the strongest, spread over the image.
        min_probability: smallest probability of an accepted match, in [0, 1].
        threads: threads to encode and search on.

    Raises:
        FileNotFoundError, FileError: there is no such map, or it is broken.
        ValueError: no landmark of the map has a position, or its encoder was not calibrated.
    """

    def __init__(
        self,
        scene: pm.PrototypeMap | pm.SealedMap | str | Path,
        *,
        max_keypoints: int = 2000,
        min_probability: float = MIN_PROBABILITY,
        threads: int = 1,
    ) -> None:
        self.scene = open_map(scene) if isinstance(scene, (str, Path)) else scene
        self.max_keypoints = max_keypoints
        self.min_probability = min_probability
        self.threads = threads
        self._ids = self.scene.ids
        self._positions = self.scene.positions(self._ids)
        if not np.isfinite(self._positions).all(axis=1).any():
            raise ValueError(
                f"none of the map's {len(self._ids)} landmarks has a position, so images cannot be "
                "localized in it: set positions with `set_positions`, or build the map from tracks"
            )
        self.calibration = MatchCalibration.of(self.scene.encoder, self.scene.dim)
        self._extractor: Extractor | None = None

    def localize(
        self,
        image: str | Path | NDArray[np.uint8],
        camera: Camera | str | None = None,
        prior: PosePrior | None = None,
        *,
        focal_length: FocalLength = "known",
    ) -> Localization:
        """Find the pose of an image.

        Args:
            image: a file, or a (height, width) grey or (height, width, 3) BGR uint8 array.
            camera: its camera, or the camera written out as "MODEL:PARAMETERS"; None: a pinhole
                camera whose focal length is estimated.
            prior: a rough pose; only landmarks that are visible from near it are searched.
            focal_length: "known", "rough" to have it refined, or "unknown" to have it estimated.

        Returns:
            The pose, with its confidence and inliers, or the reason why there is none.

        Raises:
            FileNotFoundError, ValueError: the image cannot be read or is not of the camera's size,
                or OpenCV does not compute the map's descriptor.
        """
        began = time.perf_counter()
        gray = read_gray(Path(image)) if isinstance(image, (str, Path)) else to_gray(image)
        height, width = gray.shape
        if isinstance(camera, str):
            camera = Camera.parse(camera)
        if camera is None:
            camera, focal_length = Camera.guess(width, height), "unknown"
        elif not camera.width:
            camera = replace(camera, width=width, height=height)
        elif (camera.width, camera.height) != (width, height):
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
            descriptors: (n, bits / 8) uint8, of the kind that the map's encoder takes.
            camera: the frame's camera.
            prior: see `localize`.
            focal_length: see `localize`.
            seconds: seconds of earlier stages by name, to be included in the result.

        Returns:
            See `localize`.

        Raises:
            ValueError: the lengths differ, the encoder takes other descriptors, or poses cannot be
                estimated for this camera model.
        """
        check_pose_model(camera)
        if len(keypoints) != len(descriptors):
            raise ValueError(f"{len(keypoints)} keypoints, but {len(descriptors)} descriptors")
        stages = dict(seconds or {})
        with _timed(stages, "encode"):
            codes = self.scene.encoder.encode(descriptors, self.scene.dim, self.threads)
        with _timed(stages, "search"):
            searched: pm.PrototypeMap | pm.SealedMap | Subset = self.scene
            if prior is not None:
                searched = Subset(self.scene, self._ids[visible(prior, camera, self._positions)])
            ids, distances = searched.search_codes(codes, k=CANDIDATES, threads=self.threads)
        with _timed(stages, "pose"):
            candidates = Candidates(
                np.asarray(keypoints, np.float64).reshape(-1, 2),
                ids,
                self._positions_of(ids),
                self.calibration.probability(distances),
            )
            result = solve_pose(candidates, camera, self.min_probability, focal_length)
        return replace(result, seconds={**stages, "total": sum(stages.values())})

    def _positions_of(self, ids: NDArray[np.int64]) -> NDArray[np.float64]:
        """Positions (..., 3) of ids (...), NaN if the id is -1 or has no position."""
        where = np.minimum(np.searchsorted(self._ids, ids), len(self._ids) - 1)
        return np.where((ids >= 0)[..., None], self._positions[where], np.nan)

    def _extract(self, image: NDArray[np.uint8]) -> Features:
        descriptor = self.scene.encoder.descriptor
        if self._extractor is None:
            if descriptor.removesuffix(SUFFIX) not in DESCRIPTORS:
                raise ValueError(
                    f"the map's encoder takes {descriptor} descriptors, which OpenCV does not "
                    "compute: describe the keypoints yourself and call localize_features"
                )
            self._extractor = Extractor(descriptor.removesuffix(SUFFIX), self.max_keypoints)
        features = self._extractor(image)
        if descriptor.endswith(SUFFIX):
            features.descriptors = upright_descriptors(
                features.descriptors, features.angles, features.sizes
            )
        return features


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - began
