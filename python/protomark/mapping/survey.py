"""Surveys the first frames before the map starts: which of them moved, and how they match."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from protomark.features.descriptors import InputKind
from protomark.features.extractor import Extractor, Features
from protomark.geometry.camera import Camera
from protomark.geometry.given_poses import agreeing, pose_errors
from protomark.geometry.pose import turned
from protomark.mapping.frame import Array, InputImage
from protomark.mapping.initialisation import RATIO
from protomark.tracks.matching import mutual_matches

# This many frames are surveyed, out of at most so many.
_FRAMES = 24
_MAX_READ = 150
# A frame is taken once a fifth of its matches with the last one has moved by this share of the
# image's longer side: an overlay or a bonnet that never moves may hold all others.
_MIN_MOTION = 0.02
_MOVED_SHARE = 0.2
# Each frame is matched with those that come so many frames later.
_STEPS = (1, 2, 4, 8)
_MIN_MATCHES = 50
# A frame follows another if this share of its keypoints match: fewer do so by chance.
_FOLLOWING = 0.05


@dataclass
class Survey:
    """What the first frames show."""

    pairs: list[MatchedPair]  # matches of frames that moved
    # Features by image name, so that the map need not detect them again.
    features: dict[str, Features]
    ordered: bool  # whether most frames match the next one
    # (height, width) bool, the part of the image to leave out; None: nothing.
    mask: NDArray[np.bool_] | None = None
    seconds: float = 0.0  # how long the survey took

    def pose_errors(self, camera: Camera, pixel: float) -> list[Array]:
        """Errors of given poses for each pair whose matches can tell; `pixel`: see `pixel_size`."""
        errors = []
        for pair in self.pairs:
            one, other = (image.pose for image in pair.images)
            if one is None or other is None:
                continue
            cameras = [image.camera or camera for image in pair.images]
            focal = (cameras[0].focal_length + cameras[1].focal_length) / 2 / pixel
            agree = agreeing(cameras[0].rays(pair.first), cameras[1].rays(pair.second), focal)
            if agree.any():
                first, turns = cameras[0].local_rays(pair.first[agree])
                second, other_turns = cameras[1].local_rays(pair.second[agree])
                poses = turned(one, turns), turned(other, other_turns)
                errors.append(pose_errors(*poses, first, second, focal))
        return errors


@dataclass
class MatchedPair:
    """Keypoints of two frames that match."""

    images: tuple[InputImage, InputImage]  # the two images
    first: Array  # (n, 2) float64, pixels in the earlier frame
    second: Array  # (n, 2) float64, pixels in the later one


def survey(
    images: Iterable[InputImage],
    extractor: Extractor,
    size: tuple[int, int],
    known: dict[str, Features],  # features by image name
) -> Survey:
    """Match the first frames that moved with each other; images of another size do not count."""
    frames: list[tuple[InputImage, Features]] = []
    kind = extractor.kind.input
    for count, image in enumerate(images):
        if len(frames) == _FRAMES or count == _MAX_READ:
            break
        if image.image is None or image.image.shape[::-1] != size:
            continue
        features = known.get(image.name) or extractor(image.image)
        new = replace(image, image=None), features
        if len(features) < _MIN_MATCHES:
            continue
        if frames and not _moved(_pair(frames[-1], new, kind), size):
            continue
        frames.append(new)
    pairs = [
        _pair(frame, frames[i + step], kind)
        for i, frame in enumerate(frames)
        for step in _STEPS
        if i + step < len(frames)
    ]
    following = [
        len(_pair(one, other, kind).first) >= _FOLLOWING * len(one[1])
        for one, other in pairwise(frames)
    ]
    return Survey(
        [pair for pair in pairs if len(pair.first) >= _MIN_MATCHES],
        {**known, **{image.name: features for image, features in frames}},
        2 * sum(following) >= len(following),
    )


def _pair(
    one: tuple[InputImage, Features], other: tuple[InputImage, Features], kind: InputKind
) -> MatchedPair:
    rows = mutual_matches(one[1].descriptors, other[1].descriptors, RATIO, kind)
    first, second = one[1].keypoints[rows[:, 0]], other[1].keypoints[rows[:, 1]]
    images = one[0], other[0]
    return MatchedPair(images, first.astype(np.float64), second.astype(np.float64))


def _moved(pair: MatchedPair, size: tuple[int, int]) -> bool:
    if len(pair.first) < _MIN_MATCHES:
        return True
    motion = np.linalg.norm(pair.second - pair.first, axis=1)
    return float(np.quantile(motion, 1 - _MOVED_SHARE)) > _MIN_MOTION * max(size)
