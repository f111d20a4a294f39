"""SIFT as COLMAP keeps it: RootSIFT in bytes (Arandjelovic and Zisserman, CVPR 2012)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.extras import optional

NORM = 512.0  # of a descriptor, up to rounding
# SIFT is cut at 0.2 of its length and RootSIFT is its root, so that the sum of its numbers, in
# lengths, is 7.9 to 9.0 on average over an image, and 5.9 to 6.7 without the root.
_ROOTED_SUM = 7.25


def root_sift(descriptors: NDArray[Any]) -> NDArray[np.uint8]:
    """RootSIFT of SIFT's (n, 128) numbers, which are not negative, however long they are."""
    rows = np.asarray(descriptors, np.float64)
    share = rows / np.maximum(rows.sum(1, keepdims=True), np.finfo(np.float64).tiny)
    return np.minimum(np.rint(NORM * np.sqrt(share)), 255).astype(np.uint8)


def is_rooted(descriptors: NDArray[np.uint8]) -> bool:
    """Whether (n, 128) bytes of many keypoints are RootSIFT already, which their sum tells.

    Raises:
        ValueError: they are not SIFT, as their length is not 512.
    """
    rows = descriptors.astype(np.float32)
    rows = rows[rows.any(1)]
    lengths = np.linalg.norm(rows, axis=1)
    if len(rows) and abs(float(np.median(lengths)) / NORM - 1) > 0.1:
        raise ValueError(
            f"descriptors of 128 numbers with a length of {np.median(lengths):.0f}, where SIFT has "
            f"{NORM:.0f}"
        )
    return not len(rows) or float((rows.sum(1) / lengths).mean()) > _ROOTED_SUM


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
        """OpenCV's keypoints of a (height, width) image."""
        return self._sift.detect(image, None)

    def compute(
        self, image: NDArray[np.uint8], keypoints: Sequence[Any]
    ) -> tuple[Sequence[Any], NDArray[np.uint8] | None]:
        """Keypoints and their descriptors (n, 128)."""
        keypoints, found = self._sift.compute(image, keypoints)
        return keypoints, None if found is None else root_sift(found)


def colmap_sift(
    detector: Mapping[str, Any], limit: int
) -> Callable[[NDArray[np.uint8], None], tuple[list[Any], NDArray[np.uint8]]]:
    """COLMAP's extractor with its defaults, for up to about `limit` keypoints of the largest scale.

    Returns:
        A function like OpenCV's `detectAndCompute`. COLMAP knows no response, and prefers large
        keypoints: their scale is their response.
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
            scale, turn = k.compute_scale(), np.degrees(k.compute_orientation())
            at = (k.x - 0.5, k.y - 0.5, 2 * scale, turn % 360, scale, round(np.log2(scale)))
            keypoints.append(cv2.KeyPoint(*at))
        return keypoints, np.asarray(descriptors.data, np.uint8)

    return extract
