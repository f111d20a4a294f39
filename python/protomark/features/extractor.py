"""Detects keypoints in an image and describes them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.extras import missing, optional
from protomark.features.descriptors import descriptor_kind
from protomark.geometry.neighbours import near_pairs

# Two keypoints closer than this (pixels) are one place in the image, found at two pyramid levels or
# at two corners of one edge. As landmarks they would look alike and lie within the error of each
# other, so that nobody could say which of them a query should find.
MIN_DISTANCE = 4.0

_AKAZE_THRESHOLDS = (1e-3, 1e-4)  # strict first, then for images with little contrast


FEATURE_ARRAYS = ("keypoints", "sizes", "angles", "responses", "octaves", "descriptors")


@dataclass
class Features:
    """n keypoints of one image with their descriptors.

    Attributes:
        keypoints: (n, 2) float32, pixels; the centre of the upper left pixel is (0.5, 0.5).
        sizes: (n,) float32, diameter in pixels.
        angles: (n,) float32, degrees clockwise in [0, 360), -1 where there is none.
        responses: (n,) float32, strength given by the detector.
        octaves: (n,) int32, pyramid level given by the detector.
        descriptors: (n, bits / 8) uint8.
    """

    keypoints: NDArray[np.float32]
    sizes: NDArray[np.float32]
    angles: NDArray[np.float32]
    responses: NDArray[np.float32]
    octaves: NDArray[np.int32]
    descriptors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.keypoints)

    def where(self, rows: NDArray[Any]) -> Features:
        """The keypoints at these rows (k,), or for which `rows` (n,) is true."""
        return Features(*(getattr(self, name)[rows] for name in FEATURE_ARRAYS))


class Extractor:
    """Detects and describes the keypoints of images.

    OpenCV's detectors are not safe to share between threads, so each thread needs an extractor.

    Args:
        name: name of the descriptor, see `protomark.features.descriptors.DESCRIPTORS`.
        max_keypoints: the most keypoints to keep in an image: the strongest, spread over it.
    """

    def __init__(self, name: str, max_keypoints: int = 2000) -> None:
        cv2 = optional("cv2")
        if max_keypoints < 1:
            raise ValueError(f"max_keypoints is {max_keypoints}, it must be at least 1")
        self.kind = descriptor_kind(name)
        self.max_keypoints = max_keypoints
        if not hasattr(cv2, "xfeatures2d"):
            raise missing("cv2.xfeatures2d")
        extra = cv2.xfeatures2d
        # Detectors with a strict threshold first, then with lower ones for little contrast.
        self._detect: list[Callable[[Any], Sequence[Any]]]
        self._akaze: Callable[[Any, None], tuple[Sequence[Any], Any]] | None = None
        self._high_contrast = False
        brisk = getattr(extra, "BRISK_create", None) or cv2.BRISK_create
        akaze = getattr(extra, "AKAZE_create", None) or cv2.AKAZE_create
        orb = [cv2.ORB_create(nfeatures=5 * max_keypoints, fastThreshold=t) for t in (20, 7)]
        if self.kind.name in ("freak", "brisk"):
            self._detect = [brisk(thresh=t, octaves=3).detect for t in (30, 18, 10)]
        elif self.kind.name == "akaze":
            self._detect = [akaze(threshold=t).detect for t in _AKAZE_THRESHOLDS]
            self._akaze = akaze(threshold=_AKAZE_THRESHOLDS[-1]).detectAndCompute
        else:
            self._detect = [o.detect for o in orb]
        self._compute = {
            "freak": lambda: extra.FREAK_create(),
            "orb": lambda: orb[0],
            "brisk": lambda: brisk(),
            "akaze": lambda: akaze(),
            "latch": lambda: extra.LATCH_create(bytes=32),
            "beblid": lambda: extra.BEBLID_create(1.0, extra.BEBLID_SIZE_512_BITS),
            "teblid": lambda: extra.TEBLID_create(1.0, extra.TEBLID_SIZE_256_BITS),
        }[self.kind.name]().compute

    def __call__(self, image: NDArray[np.uint8]) -> Features:
        """Features of a (height, width) uint8 image, the strongest first."""
        # Some descriptors drop keypoints near the border, FREAK silently.
        described, descriptors = self._describe(image)
        if descriptors is None or not len(described):
            descriptors = np.zeros((0, self.kind.bytes), np.uint8)
        descriptors = np.ascontiguousarray(descriptors, np.uint8)
        if descriptors.shape != (len(described), self.kind.bytes):
            raise ValueError(
                f"OpenCV gave {self.kind.name} descriptors of {descriptors.shape[1]} bytes, "
                f"expected {self.kind.bytes}"
            )
        n = len(described)
        xy = np.array([k.pt for k in described], np.float32).reshape(n, 2)
        sizes = np.array([k.size for k in described], np.float32)
        angles = np.array([k.angle for k in described], np.float32)
        responses = np.array([k.response for k in described], np.float32)
        octaves = np.array([k.octave for k in described], np.int32)
        # -1 is OpenCV's "no angle"; orientations come in (-180, 180] or [0, 360).
        angles = np.where(angles == -1, -1, np.mod(angles, 360)).astype(np.float32)
        angles[angles >= 360] = 0
        # Some descriptors sort keypoints by pyramid level.
        order = np.lexsort((octaves, xy[:, 0], xy[:, 1], -responses))
        xy += np.float32(0.5)
        return Features(xy, sizes, angles, responses, octaves, descriptors).where(order)

    def _describe(self, image: NDArray[np.uint8]) -> tuple[Sequence[Any], Any]:
        """The selected keypoints, and their descriptors."""
        if self._akaze is not None:
            return self._describe_akaze(image, self._akaze)
        for detect in self._detect:
            selected, enough = self._select(detect(image), image)
            if enough:
                break
        return self._compute(image, selected)

    def _describe_akaze(
        self, image: NDArray[np.uint8], akaze: Callable[[Any, None], tuple[Sequence[Any], Any]]
    ) -> tuple[Sequence[Any], Any]:
        """The same for AKAZE, with the scale space, which is most of the work, built once.

        At the low threshold keypoints and descriptors come from one scale space. Whether the strict
        threshold suffices is guessed from the image before; the result does not depend on it.
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


def _spread(found: Sequence[Any], width: int, height: int, limit: int) -> list[int]:
    """Up to `limit` keypoints, the strongest in each cell of a grid first, none too close."""
    if not found:
        return []
    xy = np.array([k.pt for k in found], np.float64)
    response = np.array([k.response for k in found], np.float64)
    order = np.lexsort(([k.octave for k in found], xy[:, 0], xy[:, 1], -response))
    order = order[: 5 * limit]
    order = order[_apart(xy[order], MIN_DISTANCE)]
    # About four keypoints per cell if they were spread evenly.
    cell = max(1.0, float(np.sqrt(width * height / max(1.0, limit / 4))))
    columns = int(width // cell) + 1
    cells = (xy[order, 1] // cell).astype(np.int64) * columns + (xy[order, 0] // cell).astype(
        np.int64
    )
    by_cell = np.argsort(cells, kind="stable")
    starts = np.flatnonzero(np.diff(cells[by_cell], prepend=-1))
    rank = np.empty(len(cells), np.int64)
    rank[by_cell] = np.arange(len(cells)) - np.repeat(
        starts, np.diff(np.append(starts, len(cells)))
    )
    chosen: list[int] = order[np.argsort(rank, kind="stable")[:limit]].tolist()
    return chosen


def _apart(xy: NDArray[np.float64], distance: float) -> NDArray[np.int64]:
    """Indices of the points left when each point removes all later ones closer than `distance`."""
    later, earlier = near_pairs(xy, xy, distance)
    close = (earlier < later) & (((xy[later] - xy[earlier]) ** 2).sum(1) < distance * distance)
    later, earlier = later[close], earlier[close]
    remaining = np.ones(len(xy), bool)
    while len(later):
        # A point with no earlier neighbour left stays, and its later neighbours are removed.
        undecided = np.zeros(len(xy), bool)
        undecided[later] = True
        removed = np.zeros(len(xy), bool)
        removed[later[~undecided[earlier]]] = True
        remaining &= ~removed
        pending = undecided[earlier] & ~removed[earlier] & ~removed[later]
        later, earlier = later[pending], earlier[pending]
    return np.flatnonzero(remaining)
