"""Orders photos that were taken, or are named, in no order: each after one that it matches."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from protomark.features.extractor import Extractor, Features
from protomark.mapping.frame import InputImage
from protomark.mapping.initialisation import RATIO
from protomark.progress import Progress
from protomark.tracks.matching import mutual_matches

# All pairs are matched, by their strongest keypoints: more photos would take too long.
_MAX_IMAGES = 400
_KEYPOINTS = 500
# Another order is taken only if neighbours in it have so many times the matches.
_MIN_GAIN = 1.5


def matching_order(
    images: Iterable[InputImage],
    count: int,
    extractor: Extractor,
    features: dict[str, Features],  # what is known already; what is detected is added
    progress: Progress,
) -> list[str]:
    """Names of the images, each after one that it matches well; none if the given order is as good.

    Starting at one end, the image with most matches with the last one comes next (as travelling
    salesmen go to the nearest town); if none matches, the one that matches any before best.
    """
    if count > _MAX_IMAGES:
        return []
    names: list[str] = []
    kind = extractor.kind.input
    described: list[NDArray[np.uint8]] = []
    for image in images:
        progress("look for an order", len(names), count)
        if image.image is not None and image.name not in features:
            features[image.name] = extractor(image.image)
        names.append(image.name)
        found = features.get(image.name)
        if found is None:
            described.append(np.zeros((0, extractor.kind.bytes), np.uint8))
        else:
            strongest = np.argsort(-found.responses, kind="stable")[:_KEYPOINTS]
            described.append(found.descriptors[strongest])
    shared = np.zeros((len(names), len(names)), np.int64)
    for i, first in enumerate(described):
        progress("match all photos", i, count)
        for j, second in enumerate(described[:i]):
            shared[i, j] = shared[j, i] = len(mutual_matches(first, second, RATIO, kind))
    # A walk from anywhere ends at an end of the scene, where the next begins.
    order = _walk(shared, _walk(shared, int(shared.sum(1).argmax()))[-1])
    given = np.arange(len(names))
    if _neighbours(shared, order) < _MIN_GAIN * _neighbours(shared, given):
        return []
    return [names[i] for i in order]


def _walk(shared: NDArray[np.int64], start: int) -> NDArray[np.int64]:
    """All rows of a matrix (n, n) of matches, from one to the next that matches it best."""
    order = [start]
    left = np.ones(len(shared), bool)
    left[start] = False
    while left.any():
        # Few matches are matches by chance, which any two images have.
        matches = shared[order[-1]]
        if matches[left].max() <= np.median(matches):
            matches = shared[order].max(axis=0)
        order.append(int(np.argmax(np.where(left, matches, -1))))
        left[order[-1]] = False
    return np.array(order)


def _neighbours(shared: NDArray[np.int64], order: NDArray[np.int64]) -> float:
    """Median number of matches between neighbours in an order."""
    return float(np.median(shared[order[:-1], order[1:]]))
