"""Keypoints and binary descriptors of one image, each descriptor with its usual detector."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.tracks.nearby import near_pairs

# Two keypoints closer than this (pixels) are one place in the image, found twice: at two pyramid
# levels, or at two corners of one edge. Both would become landmarks that look alike and lie within
# the error of each other, so that no one could say which of them a query should find.
MIN_DISTANCE = 4.0

_AKAZE = (1e-3, 1e-4)  # thresholds: strict, then for images with little contrast


@dataclass(frozen=True)
class DescriptorKind:
    """A descriptor as it is commonly used.

    Attributes:
        name: name on the command line and in files, for example "freak".
        bytes: length of a descriptor in bytes.
        detector: the detector that finds its keypoints.
    """

    name: str
    bytes: int
    detector: str

    @property
    def bits(self) -> int:
        """Length of a descriptor in bits."""
        return 8 * self.bytes


# The pairs are explained, with sources, in docs/tracks.md.
DESCRIPTORS = {
    kind.name: kind
    for kind in (
        DescriptorKind("freak", 64, "BRISK (multi-scale AGAST)"),
        DescriptorKind("orb", 32, "ORB (oriented FAST)"),
        DescriptorKind("brisk", 64, "BRISK (multi-scale AGAST)"),
        DescriptorKind("akaze", 61, "AKAZE"),
        DescriptorKind("latch", 32, "ORB (oriented FAST)"),
        DescriptorKind("beblid", 64, "ORB (oriented FAST)"),
        DescriptorKind("teblid", 32, "ORB (oriented FAST)"),
    )
}


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


def descriptor_kind(name: str) -> DescriptorKind:
    """The descriptor of that name.

    Raises:
        ValueError: there is none; the sentence lists those there are.
    """
    try:
        return DESCRIPTORS[name.lower()]
    except KeyError:
        raise ValueError(
            f"{name}: unknown descriptor, choose one of {', '.join(DESCRIPTORS)}"
        ) from None


def read_gray(path: Path) -> NDArray[np.uint8]:
    """Read an image as (height, width) uint8, exactly as stored (no rotation by EXIF).

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is no image, or is cut off.
    """
    import cv2

    if not path.is_file():
        raise FileNotFoundError(f"{path}: image is missing, though the model names it")
    data = np.fromfile(path, dtype=np.uint8)
    # OpenCV fills the missing rows of a cut-off image with grey and only warns.
    start, end = data[:4].tobytes(), data[-4096:].tobytes()
    for magic, last in ((b"\xff\xd8", b"\xff\xd9"), (b"\x89PNG", b"IEND")):
        if start.startswith(magic) and last not in end:
            raise ValueError(
                f"{path}: image is truncated (its end marker is missing), copy it anew"
            )
    image = (
        cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        if len(data)
        else None
    )
    if image is None:
        raise ValueError(f"{path}: not a readable image, or a truncated one; copy it")
    return np.asarray(image, dtype=np.uint8)


class Extractor:
    """Finds and describes the keypoints of images; one per thread (OpenCV's are not shared).

    Args:
        name: name of the descriptor, see `DESCRIPTORS`.
        max_keypoints: how many keypoints an image keeps, the strongest, spread over the image.
    """

    def __init__(self, name: str, max_keypoints: int = 2000) -> None:
        import cv2

        if max_keypoints < 1:
            raise ValueError(f"max_keypoints is {max_keypoints}, it must be at least 1")
        self.kind = descriptor_kind(name)
        self.max_keypoints = max_keypoints
        if not hasattr(cv2, "xfeatures2d"):
            raise ModuleNotFoundError(
                "this OpenCV lacks xfeatures2d: pip install opencv-contrib-python-headless"
            )
        extra: Any = cv2.xfeatures2d
        # Strict first, then a lower threshold for images with little contrast.
        self._detect: list[Callable[[Any], Sequence[Any]]]
        self._at_once: Callable[[Any, None], tuple[Sequence[Any], Any]] | None = None
        self._rich = False
        brisk = getattr(extra, "BRISK_create", None) or cv2.BRISK_create  # type: ignore[attr-defined]
        akaze = getattr(extra, "AKAZE_create", None) or cv2.AKAZE_create  # type: ignore[attr-defined]
        orb = [
            cv2.ORB_create(nfeatures=5 * max_keypoints, fastThreshold=t)  # type: ignore[attr-defined]
            for t in (20, 7)
        ]
        if self.kind.name in ("freak", "brisk"):
            self._detect = [brisk(thresh=t, octaves=3).detect for t in (30, 18, 10)]
        elif self.kind.name == "akaze":
            self._detect = [akaze(threshold=t).detect for t in _AKAZE]
            self._at_once = akaze(threshold=_AKAZE[-1]).detectAndCompute
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
        """Features of a (height, width) uint8 image, in a fixed order: strongest first."""
        # Descriptors drop keypoints near the border (FREAK without a word): take what comes back.
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
        # Descriptors may sort by level: back to strongest first, then by place.
        order = np.lexsort((octaves, xy[:, 0], xy[:, 1], -responses))
        return Features(
            xy[order] + np.float32(0.5),
            sizes[order],
            angles[order],
            responses[order],
            octaves[order],
            descriptors[order],
        )

    def _describe(self, image: NDArray[np.uint8]) -> tuple[Sequence[Any], Any]:
        """Keypoints, few enough and spread, and their descriptors."""
        if self._at_once is not None:
            return self._describe_at_once(image, self._at_once)
        for detect in self._detect:
            found, enough = self._few(detect(image), image)
            if enough:
                break
        return self._compute(image, found)

    def _describe_at_once(
        self, image: NDArray[np.uint8], at_once: Callable[[Any, None], tuple[Sequence[Any], Any]]
    ) -> tuple[Sequence[Any], Any]:
        """The same of AKAZE, whose scale space is most of the work.

        Where the last threshold is needed it is built once, not for each threshold and for the
        descriptors, too. Whether it will be, the image before tells, mostly.
        """
        strict = _AKAZE[0]
        if not self._rich:
            every, descriptors = at_once(image, None)
            _, self._rich = self._few([k for k in every if k.response > strict], image)
        if self._rich:
            found, self._rich = self._few(self._detect[0](image), image)
            if self._rich:
                return self._compute(image, found)
            every, descriptors = at_once(image, None)
        chosen = _spread(every, image.shape[1], image.shape[0], self.max_keypoints)
        return [every[i] for i in chosen], descriptors[chosen] if chosen else None

    def _few(self, found: Sequence[Any], image: NDArray[np.uint8]) -> tuple[list[Any], bool]:
        """The keypoints to keep, and whether they are as many as there may be."""
        chosen = _spread(found, image.shape[1], image.shape[0], self.max_keypoints)
        return [found[i] for i in chosen], len(chosen) >= self.max_keypoints


def _spread(found: Sequence[Any], width: int, height: int, limit: int) -> list[int]:
    """Up to `limit` keypoints: in each cell of a grid the strongest first, none too close."""
    if not found:
        return []
    xy = np.array([k.pt for k in found], np.float64)
    response = np.array([k.response for k in found], np.float64)
    order = np.lexsort(([k.octave for k in found], xy[:, 0], xy[:, 1], -response))
    order = order[: 5 * limit]
    order = order[_apart(xy[order], MIN_DISTANCE)]
    # About four keypoints a cell if all cells were equally rich.
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
    left = np.ones(len(xy), bool)
    while len(later):
        # A point that no other one left can remove stays, and what it removes goes.
        open_ = np.zeros(len(xy), bool)
        open_[later] = True
        gone = np.zeros(len(xy), bool)
        gone[later[~open_[earlier]]] = True
        left &= ~gone
        unsure = open_[earlier] & ~gone[earlier] & ~gone[later]
        later, earlier = later[unsure], earlier[unsure]
    return np.flatnonzero(left)
