"""Detects and describes the keypoints of images."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.extras import optional
from protomark.features.descriptors import descriptor_kind
from protomark.features.sift import OpenCvSift, colmap_sift
from protomark.geometry.neighbours import near_pairs, runs

# Two keypoints closer than this (pixels) are one image point, detected at two pyramid levels or at
# two corners of one edge. As landmarks their descriptors would be alike and their distance within
# the error, so that a query could not tell them apart.
MIN_DISTANCE = 4.0

_AKAZE_THRESHOLDS = (1e-3, 1e-4)  # the second is for images with little contrast
_SIFT_THRESHOLDS = (0.02, 0.0067)  # COLMAP's, and one for images with little contrast

# Images whose longer side is larger are reduced to this many pixels before detection.
MAX_SIZE = 1600
_MIN_MAX_SIZE = 64
MAX_KEYPOINTS = 2000  # per image, unless somebody wants others

FEATURE_ARRAYS = ("keypoints", "sizes", "angles", "responses", "octaves", "descriptors")


@dataclass
class Features:
    """n keypoints of one image with their descriptors."""

    # (n, 2) float32, pixels; the centre of the upper left pixel is (0.5, 0.5).
    keypoints: NDArray[np.float32]
    sizes: NDArray[np.float32]  # (n,) float32, diameter in pixels
    # (n,) float32, degrees clockwise in [0, 360), -1 where there is none.
    angles: NDArray[np.float32]
    responses: NDArray[np.float32]  # (n,) float32, the detector's strength
    octaves: NDArray[np.int32]  # (n,) int32, the detector's pyramid level
    descriptors: NDArray[np.uint8]  # (n, bytes) uint8

    def __len__(self) -> int:
        return len(self.keypoints)

    def where(self, rows: NDArray[Any]) -> Features:
        """The keypoints at these rows (k,), or for which `rows` (n,) is true."""
        return Features(*(getattr(self, name)[rows] for name in FEATURE_ARRAYS))

    def scaled(self, scale: tuple[float, float]) -> Features:
        """The keypoints in an image of so many times the width and height."""
        return replace(
            self,
            keypoints=self.keypoints * np.array(scale, np.float32),
            sizes=self.sizes * np.float32(np.mean(scale)),
        )


def reduced_size(size: tuple[int, int], max_size: int) -> tuple[int, int]:
    """Width and height in pixels that features of images of this size are detected at."""
    width, height = (max(1, round(side / pixel_size(size, max_size))) for side in size)
    return width, height


def pixel_size(size: tuple[int, int], max_size: int) -> float:
    """Size of a pixel that features are detected at, in pixels of images of this size."""
    return max(1.0, max(size) / max_size)


class Extractor(threading.local):
    """Detects and describes the keypoints of images; threads may share it.

    OpenCV's detectors are not safe to share between threads, so each thread makes its own.

    Args:
        name: name of the descriptor, see `protomark.features.descriptors.DESCRIPTORS`.
        max_keypoints: limit on keypoints per image: the strongest, spread over the image.
        max_size: images whose longer side has more pixels are reduced to it before detection.
        detector: how images were described that these will be matched with, as `Tracks.info` has
            it: "levels" and "scale_factor" of ORB's image pyramid; "name" if it begins with GFTT
            or COLMAP, whose SIFT may be "upright".

    Raises:
        ValueError: a number or the name is out of range.
    """

    def __init__(
        self,
        name: str,
        max_keypoints: int = MAX_KEYPOINTS,
        max_size: int = MAX_SIZE,
        detector: Mapping[str, Any] | None = None,
    ) -> None:
        if max_keypoints < 1:
            raise ValueError(f"max_keypoints is {max_keypoints}, but it must be at least 1")
        if max_size < _MIN_MAX_SIZE:
            raise ValueError(f"max_size is {max_size}, but it must be at least {_MIN_MAX_SIZE}")
        self.kind = descriptor_kind(name)
        self.max_keypoints, self.max_size = max_keypoints, max_size
        settings = detector or {}
        pyramid = _pyramid(settings)

        def orb(**threshold: int) -> Any:
            return _opencv("ORB_create")(nfeatures=5 * max_keypoints, **pyramid, **threshold)

        # The first detector has a strict threshold, the others lower ones for little contrast.
        self._detect: list[Callable[[Any], Sequence[Any]]]
        # Detects and describes at once.
        self._whole: Callable[[Any, None], tuple[Sequence[Any], Any]] | None = None
        self._high_contrast = False
        if self.kind.name in ("freak", "brisk"):
            brisk = _opencv("BRISK_create")
            self._detect = [brisk(thresh=t, octaves=3).detect for t in (30, 18, 10)]
        elif self.kind.name == "akaze":
            akaze = [_opencv("AKAZE_create")(threshold=t) for t in _AKAZE_THRESHOLDS]
            self._detect = [a.detect for a in akaze]
            self._whole = akaze[-1].detectAndCompute
        elif self.kind.name == "sift" and str(settings.get("name")).startswith("COLMAP"):
            self._detect, self._whole = [], colmap_sift(settings, max_keypoints)
        elif self.kind.name == "sift":
            self._detect = [OpenCvSift(t).detect for t in _SIFT_THRESHOLDS]
        elif str(settings.get("name")).startswith("GFTT"):  # RTAB-Map's
            self._detect = [_good_features(settings, 5 * max_keypoints).detect]
        else:
            self._detect = [orb(fastThreshold=t).detect for t in (20, 7)]
        describe: dict[str, Callable[[], Any]] = {
            "freak": lambda: _opencv("FREAK_create")(),
            "orb": lambda: orb(fastThreshold=20),
            "brisk": lambda: _opencv("BRISK_create")(),
            "akaze": lambda: _opencv("AKAZE_create")(),
            "latch": lambda: _opencv("LATCH_create")(bytes=32),
            "beblid": lambda: _opencv("BEBLID_create")(1.0, _opencv("BEBLID_SIZE_512_BITS")),
            "sift": lambda: OpenCvSift(_SIFT_THRESHOLDS[0]),
            "teblid": lambda: _opencv("TEBLID_create")(1.0, _opencv("TEBLID_SIZE_256_BITS")),
        }
        self._compute = describe[self.kind.name]().compute

    def __call__(self, image: NDArray[np.uint8]) -> Features:
        """The features of a (height, width) uint8 image in its pixels, the strongest first.

        Raises:
            ValueError: OpenCV refuses the image, for example as it is a few pixels wide.
        """
        cv2 = optional("cv2")
        height, width = image.shape
        size = reduced_size((width, height), self.max_size)
        # Some descriptors drop keypoints near the border.
        try:
            if size != (width, height):
                image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
            described, descriptors = self._describe(image)
        except cv2.error as error:
            raise ValueError(
                f"OpenCV computes no {self.kind.name} features of {width}x{height} pixels "
                f"({error.err})"
            ) from None
        if descriptors is None or not len(described):
            descriptors = np.zeros((0, self.kind.bytes), np.uint8)
        descriptors = np.ascontiguousarray(descriptors, np.uint8)
        if descriptors.shape != (len(described), self.kind.bytes):
            raise ValueError(
                f"OpenCV returns {self.kind.name} descriptors of {descriptors.shape[1]} bytes, not "
                f"{self.kind.bytes}: install another version"
            )
        if self.kind.input != "bits":  # in an image of one grey they may be zero
            rows = np.flatnonzero(descriptors.any(1)).tolist()
            described, descriptors = [described[i] for i in rows], descriptors[rows]
        n = len(described)
        xy = np.array([k.pt for k in described], np.float32).reshape(n, 2)
        sizes = np.array([k.size for k in described], np.float32)
        angles = np.array([k.angle for k in described], np.float32)
        responses = np.array([k.response for k in described], np.float32)
        octaves = np.array([k.octave for k in described], np.int32)
        if self.kind.name == "sift":  # OpenCV has the layer of the octave in the bits above
            octaves = octaves.astype(np.int8).astype(np.int32)
        # OpenCV's angles are -1 for none, or in (-180, 180] or [0, 360).
        angles = np.where(angles == -1, -1, np.mod(angles, 360)).astype(np.float32)
        angles[angles >= 360] = 0
        # Some descriptors reorder keypoints by pyramid level.
        order = np.lexsort((octaves, xy[:, 0], xy[:, 1], -responses))
        xy += np.float32(0.5)
        features = Features(xy, sizes, angles, responses, octaves, descriptors).where(order)
        return features.scaled((width / size[0], height / size[1]))

    def _describe(self, image: NDArray[np.uint8]) -> tuple[Sequence[Any], Any]:
        """Selected keypoints and their descriptors."""
        if self._whole is not None:
            if not self._detect:  # COLMAP chooses keypoints itself
                return self._whole(image, None)
            return self._describe_akaze(image, self._whole)
        for detect in self._detect:
            selected, enough = self._select(detect(image), image)
            if enough:
                break
        return self._compute(image, selected)

    def _describe_akaze(
        self, image: NDArray[np.uint8], akaze: Callable[[Any, None], tuple[Sequence[Any], Any]]
    ) -> tuple[Sequence[Any], Any]:
        """Selected AKAZE keypoints and their descriptors, with as few scale spaces as possible.

        At the low threshold keypoints and descriptors come from one scale space, which is most of
        the work. Whether the strict threshold suffices is guessed from the previous image; the
        result does not depend on the guess.
        """
        if not self._high_contrast:
            keypoints, descriptors = akaze(image, None)
            strong = [k for k in keypoints if k.response > _AKAZE_THRESHOLDS[0]]
            _, self._high_contrast = self._select(strong, image)
        if self._high_contrast:
            selected, self._high_contrast = self._select(self._detect[0](image), image)
            if self._high_contrast:
                return self._compute(image, selected)
            keypoints, descriptors = akaze(image, None)
        chosen = _spread(keypoints, image.shape[1], image.shape[0], self.max_keypoints)
        return [keypoints[i] for i in chosen], descriptors[chosen] if chosen else None

    def _select(self, found: Sequence[Any], image: NDArray[np.uint8]) -> tuple[list[Any], bool]:
        """The keypoints to keep, and whether they reach the limit."""
        chosen = _spread(found, image.shape[1], image.shape[0], self.max_keypoints)
        return [found[i] for i in chosen], len(chosen) >= self.max_keypoints


def _good_features(detector: Mapping[str, Any], limit: int) -> Any:
    """Shi and Tomasi's corners, which have no size and angle."""
    quality = _setting(detector, "quality_level", 0.001, 1e-9, 1)
    distance = _setting(detector, "min_distance", 7, 0, 1000)
    return _opencv("GFTTDetector_create")(
        limit, quality, distance, int(_setting(detector, "block_size", 3, 2, 31))
    )


def _pyramid(detector: Mapping[str, Any]) -> dict[str, Any]:
    """OpenCV's parameters for the image pyramid of a detector."""
    return {
        "nlevels": int(_setting(detector, "levels", 8, 1, 32)),
        "scaleFactor": _setting(detector, "scale_factor", 1.2, 1.01, 4),
    }


def described_keypoints(detector: Mapping[str, Any]) -> int:
    """How many keypoints a detector of other images gave at most: 2000 unless it says."""
    return int(_setting(detector, "max_keypoints", MAX_KEYPOINTS, 1, 1_000_000))


def _setting(
    detector: Mapping[str, Any], name: str, usual: float, low: float, high: float
) -> float:
    value = detector.get(name, usual)
    if not (isinstance(value, (int, float)) and low <= value <= high):
        raise ValueError(f"{name} of a detector is from {low} to {high}, not {str(value)[:40]}")
    return float(value)


def _opencv(name: str) -> Any:
    """Something of OpenCV or of its contrib module `xfeatures2d`, to which version 5 moved some."""
    cv2 = optional("cv2")
    for module in (getattr(cv2, "xfeatures2d", None), cv2):
        if hasattr(module, name):
            return getattr(module, name)
    raise ModuleNotFoundError(
        f"this OpenCV has no {name}, as another OpenCV package has overwritten "
        "opencv-contrib-python-headless: pip uninstall all of them, and install that one again"
    )


def _spread(found: Sequence[Any], width: int, height: int, limit: int) -> list[int]:
    """Indices of up to `limit` keypoints, the strongest per grid cell first, none too close."""
    if not found:
        return []
    xy = np.array([k.pt for k in found], np.float64)
    response = np.array([k.response for k in found], np.float64)
    order = np.lexsort(([k.octave for k in found], xy[:, 0], xy[:, 1], -response))
    order = order[: 5 * limit]
    order = order[_apart(xy[order], MIN_DISTANCE)]
    # Evenly spread keypoints would be four per cell.
    cell = max(1.0, float(np.sqrt(width * height / max(1.0, limit / 4))))
    columns = int(width // cell) + 1
    column, row = (xy[order] // cell).astype(np.int64).T
    cells = row * columns + column
    by_cell = np.argsort(cells, kind="stable")
    starts, lengths = runs(cells[by_cell])
    rank = np.empty(len(cells), np.int64)
    rank[by_cell] = np.arange(len(cells)) - np.repeat(starts, lengths)
    chosen: list[int] = order[np.argsort(rank, kind="stable")[:limit]].tolist()
    return chosen


def _apart(xy: NDArray[np.float64], distance: float) -> NDArray[np.int64]:
    """Indices of the points that remain when each one removes all later ones within `distance`."""
    later, earlier = near_pairs(xy, xy, distance)
    close = (earlier < later) & (((xy[later] - xy[earlier]) ** 2).sum(1) < distance * distance)
    later, earlier = later[close], earlier[close]
    remaining = np.ones(len(xy), bool)
    while len(later):
        # A point without an earlier neighbour remains, and its later neighbours are removed.
        undecided = np.zeros(len(xy), bool)
        undecided[later] = True
        removed = np.zeros(len(xy), bool)
        removed[later[~undecided[earlier]]] = True
        remaining &= ~removed
        pending = undecided[earlier] & ~removed[earlier] & ~removed[later]
        later, earlier = later[pending], earlier[pending]
    return np.flatnonzero(remaining)
