"""Augments tracks for training: warps and relights each image, and detects its keypoints anew.

A keypoint of a copy belongs to the landmark whose keypoint in the original it falls on, so that an
encoder learns what detection, blur, noise, exposure, compression, rotation and scale do to a
descriptor. Positions and angles are those in the original image, so that poses and cameras remain
valid.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.extras import optional
from protomark.features.extractor import FEATURE_ARRAYS, MAX_SIZE, Extractor, Features, pixel_size
from protomark.features.images import read_gray
from protomark.geometry.neighbours import near_pairs
from protomark.progress import Progress, silent
from protomark.threads import parallel_map
from protomark.tracks.file import Tracks

# Increased whenever the same tracks yield other augmentations.
METHOD = 1
_MAX_DISTANCE = 2.0  # pixels, between keypoints of the copy and of the original
_MAX_SIZE_RATIO = 1.5


def augment(
    image: NDArray[np.uint8], rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.float64], float, float]:
    """A randomly warped and re-exposed copy of an image.

    Args:
        image: (height, width) uint8.
        rng: source of all random numbers.

    Returns:
        The copy, of the same shape; the homography (3, 3) from the image's pixels to the copy's
        (first pixel centre at 0, 0); its scale at the middle; its rotation in degrees, clockwise.
    """
    cv2 = optional("cv2")
    height, width = image.shape
    angle, scale = rng.normal(0, 20), float(np.exp(rng.normal(0, 0.2)))
    c, s = scale * np.cos(np.radians(angle)), scale * np.sin(np.radians(angle))
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    bend = np.eye(3)
    bend[0, 1] = rng.normal(0, 0.1)
    bend[2, :2] = rng.normal(0, 0.08, 2) / width
    middle = np.array([[1, 0, -width / 2], [0, 1, -height / 2], [0, 0, 1]])
    homography = np.linalg.inv(middle) @ turn @ bend @ middle
    warped = cv2.warpPerspective(image, homography, (width, height), borderMode=cv2.BORDER_REFLECT)
    light = np.clip(warped.astype(np.float32) / 255, 1e-3, 1) ** np.exp(rng.normal(0, 0.25))
    light = (light - 0.5) * np.exp(rng.normal(0, 0.2)) + 0.5 + rng.normal(0, 0.05)
    if rng.random() < 0.5:
        light = cv2.GaussianBlur(light, (0, 0), rng.uniform(0.3, 1.3))
    light = light + rng.normal(0, rng.uniform(0, 0.03), light.shape)
    copy = np.clip(255 * light, 0, 255).astype(np.uint8)
    if rng.random() < 0.7:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(30, 95))]
        decoded = cv2.imdecode(cv2.imencode(".jpg", copy, quality)[1], cv2.IMREAD_GRAYSCALE)
        copy = np.asarray(decoded, np.uint8)
    return copy, homography, scale, float(angle)


def add_augmentations(
    tracks: Tracks,  # tracks that `extract` made
    images: Path,  # folder of the images that the keyframes name
    count: int,  # copies of each keyframe, at least 1
    threads: int = 1,
    progress: Progress = silent,
) -> Tracks:
    """The observations of `tracks` and those in `count` augmented copies of each keyframe.

    Copies are keyframes of their own, named image#1, image#2, ..., with the original's pose.
    Keypoints without a landmark are left out. The result does not depend on the number of threads.
    """
    if count < 1:
        raise ValueError(f"{count} augmentations: give at least 1")
    if tracks.info.get("augmentations"):
        raise ValueError("these tracks are augmented already: give the plain ones")
    plain = tracks.where(tracks.landmark_of_keypoint >= 0)
    options = tracks.info.get("options", {})
    limits = int(options.get("max_keypoints", 2000)), int(options.get("max_size", MAX_SIZE))
    extractor = Extractor(tracks.descriptor, *limits, tracks.info.get("detector"))

    def copies(index: int) -> list[tuple[Features, NDArray[np.int64]]]:
        image = read_gray(images / tracks.keyframe_names[index])
        rows = plain.keypoints_of(index)
        seen = (plain.keypoints[rows], plain.sizes[rows], plain.landmark_of_keypoint[rows])
        rngs = (np.random.default_rng([index, k]) for k in range(count))
        return [_copy(image, rng, extractor, *seen) for rng in rngs]

    found = parallel_map(copies, range(len(tracks.keyframe_names)), threads, progress, "augment")
    flat = [(i, k, *one[k]) for i, one in enumerate(found) for k in range(count)]
    keyframes = np.array([i for i, *_ in flat])
    ends = int(plain.offsets[-1]) + np.cumsum([len(f) for _, _, f, _ in flat])

    values: dict[str, Any] = {
        name: np.concatenate([getattr(plain, name), *(getattr(f, name) for _, _, f, _ in flat)])
        for name in FEATURE_ARRAYS
    }
    return replace(
        plain,
        **values,
        keyframe_names=[
            *plain.keyframe_names,
            *(f"{plain.keyframe_names[i]}#{k + 1}" for i, k, *_ in flat),
        ],
        keyframe_camera=np.concatenate([plain.keyframe_camera, plain.keyframe_camera[keyframes]]),
        cam_from_world=np.concatenate([plain.cam_from_world, plain.cam_from_world[keyframes]]),
        offsets=np.concatenate([plain.offsets, ends]).astype(np.int64),
        landmark_of_keypoint=np.concatenate(
            [plain.landmark_of_keypoint, *(labels for *_, labels in flat)]
        ),
        info={**tracks.info, "augmentations": count, "augmentation_method": METHOD},
    )


def _copy(
    image: NDArray[np.uint8],
    rng: np.random.Generator,
    extractor: Extractor,
    keypoints: NDArray[np.float32],
    sizes: NDArray[np.float32],
    landmarks: NDArray[np.int64],
) -> tuple[Features, NDArray[np.int64]]:
    """Features of a copy, moved to the keypoints of the original they fall on, and landmarks."""
    copy, homography, scale, angle = augment(image, rng)
    features = extractor(copy)
    if not len(features) or not len(keypoints):
        return features.where(np.zeros(0, np.int64)), np.zeros(0, np.int64)
    # The centre of the first pixel is (0, 0) in OpenCV, and (0.5, 0.5) in COLMAP.
    there = np.column_stack([features.keypoints - 0.5, np.ones(len(features))])
    back = there @ np.linalg.inv(homography).T
    xy = back[:, :2] / back[:, 2:] + 0.5
    limit = _MAX_DISTANCE * pixel_size(image.shape, extractor.max_size)
    row, nearest = near_pairs(xy, keypoints.astype(np.float64), limit)
    gap = ((xy[row] - keypoints[nearest]) ** 2).sum(1)
    closest = np.lexsort((gap, row))
    closest = closest[np.flatnonzero(np.diff(row[closest], prepend=-1))]
    row, nearest, gap = row[closest], nearest[closest], gap[closest]
    ratio = features.sizes[row] / scale / sizes[nearest]
    fits = (ratio < _MAX_SIZE_RATIO) & (ratio > 1 / _MAX_SIZE_RATIO)
    # A keypoint of the original keeps the closest one that fits.
    order = np.lexsort((gap, ~fits, nearest))
    order = order[np.flatnonzero(np.diff(nearest[order], prepend=-1))]
    keep = np.sort(order[fits[order]])
    features.keypoints[:] = xy
    features.sizes /= np.float32(scale)
    oriented = features.angles >= 0
    features.angles[oriented] = np.mod(features.angles[oriented] - np.float32(angle), 360)
    features.angles[features.angles >= 360] = 0
    return features.where(row[keep]), landmarks[nearest[keep]]
