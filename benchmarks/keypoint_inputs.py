"""Response, octave and size of a keypoint as further bits of its descriptor: tried, not shipped.

None is part of `protomark train`; `training_ablation.py --study inputs` measures them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from protomark.sized import size_bits
from protomark.tracks.file import Tracks

_STEPS = 32  # of a response's rank
_OCTAVES = 8


def response_bits(tracks: Tracks) -> NDArray[np.uint8]:
    """(n, 4) uint8: bit i says that more than i / 32 of the keyframe's keypoints are weaker.

    Ranks within a keyframe stay when exposure and contrast change all its responses.
    """
    rank = np.empty(len(tracks.responses))
    for i in range(len(tracks.keyframe_names)):
        rows = tracks.keypoints_of(i)
        own = tracks.responses[rows]
        rank[rows] = np.searchsorted(np.sort(own), own) / max(len(own), 1)
    bits = rank[:, None] * _STEPS > np.arange(_STEPS)
    return np.packbits(bits, axis=1, bitorder="little")


def octave_bits(tracks: Tracks) -> NDArray[np.uint8]:
    """(n, 1) uint8: bit i says that the octave is above i."""
    return np.packbits(tracks.octaves[:, None] > np.arange(_OCTAVES), axis=1, bitorder="little")


INPUTS: dict[str, Callable[[Tracks], NDArray[np.uint8]]] = {
    "response": response_bits,
    "octave": octave_bits,
    "size": lambda tracks: np.packbits(size_bits(tracks.sizes), axis=1, bitorder="little"),
}


def with_inputs(tracks: Tracks, names: Sequence[str]) -> Tracks:
    """The tracks with longer descriptors: the bits of the named inputs follow their own.

    Responses are ranked among all keypoints of a keyframe, so the tracks must have kept those
    without a landmark.
    """
    return replace(
        tracks,
        descriptors=np.hstack([tracks.descriptors, *(INPUTS[name](tracks) for name in names)]),
    )
