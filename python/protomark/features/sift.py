"""SIFT as COLMAP keeps it: RootSIFT in bytes (Arandjelovic and Zisserman, CVPR 2012)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.extras import optional

NORM = 512.0  # of a descriptor, up to rounding
# Of the numbers from 1 to 16 at most the first share of RootSIFT's is 4 or less, and at least the
# second of SIFT's without the root: small numbers are common, and their roots are not small.
_ROOTED_SMALL, _PLAIN_SMALL = 0.34, 0.40


def root_sift(descriptors: NDArray[Any]) -> NDArray[np.uint8]:
    """RootSIFT of SIFT's (n, 128) numbers, which are not negative, however long they are."""
    rows = np.asarray(descriptors, np.float64)
    share = rows / np.maximum(rows.sum(1, keepdims=True), np.finfo(np.float64).tiny)
    return np.minimum(np.rint(NORM * np.sqrt(share)), 255).astype(np.uint8)


def is_rooted(descriptors: NDArray[np.uint8]) -> tuple[bool, bool]:
    """Whether (n, 128) bytes of many keypoints are RootSIFT already, and whether that is certain.

    Raises:
        ValueError: they are not SIFT, as their length is not 512.
    """
    length = float(np.median(np.linalg.norm(descriptors.astype(np.float32), axis=1)))
    if not 0.9 < length / NORM < 1.1:
        raise ValueError(f"vectors of length {length:.0f}, where SIFT has {NORM:.0f}")
    counts = np.bincount(descriptors.ravel(), minlength=256)
    small = counts[1:5].sum() / max(counts[1:17].sum(), 1)
    return small < (_ROOTED_SMALL + _PLAIN_SMALL) / 2, not _ROOTED_SMALL < small < _PLAIN_SMALL


class OpenCvSift:
    """OpenCV's SIFT at COLMAP's scales, as RootSIFT.

    Args:
        threshold: smallest contrast of a keypoint, as OpenCV counts it: 0.02 is COLMAP's default.
    """

    def __init__(self, threshold: float) -> None:
        # Without the last option keypoints are a quarter of a pixel off.
        create = optional("cv2").SIFT_create
        self._sift = create(contrastThreshold=threshold, enable_precise_upscale=True)

    def detect(self, image: NDArray[np.uint8]) -> Sequence[Any]:
        """Keypoints of a (height, width) image, the largest first.

        Their size is their response: of 2,000 such keypoints of `castle` 446 match right, and of
        those with most contrast 371.
        """
        found = sorted(self._sift.detect(image, None), key=lambda k: -k.size)
        for keypoint in found:
            keypoint.response = keypoint.size
        return found

    def compute(
        self, image: NDArray[np.uint8], keypoints: Sequence[Any]
    ) -> tuple[Sequence[Any], NDArray[np.uint8] | None]:
        """Keypoints and their descriptors (n, 128)."""
        keypoints, found = self._sift.compute(image, keypoints)
        return keypoints, None if found is None else root_sift(found)


def colmap_sift(
    detector: Mapping[str, Any], limit: int
) -> Callable[[NDArray[np.uint8], None], tuple[list[Any], NDArray[np.uint8]]]:
    """COLMAP's extractor with its defaults, for up to `limit` keypoints, the largest.

    Returns:
        A function like OpenCV's `detectAndCompute`; a keypoint's response is its size.
    """
    from protomark.geometry.colmap import pycolmap, quiet

    cv2 = optional("cv2")
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features, options.num_threads = limit, 1
    options.sift.upright = bool(detector.get("upright"))
    with quiet():
        extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)

    def extract(image: NDArray[np.uint8], _: None) -> tuple[list[Any], NDArray[np.uint8]]:
        found, descriptors = extractor.extract_from_uint8_array(image)
        keypoints = []
        for k in found:
            size, turn = 2 * k.compute_scale(), np.degrees(k.compute_orientation())
            octave = round(np.log2(size / 2))
            keypoints.append(cv2.KeyPoint(k.x - 0.5, k.y - 0.5, size, turn % 360, size, octave))
        # COLMAP leaves out whole octaves, and keeps some more than the limit.
        order = np.argsort([-k.size for k in keypoints], kind="stable")[:limit]
        return [keypoints[i] for i in order], np.asarray(descriptors.data, np.uint8)[order]

    return extract
