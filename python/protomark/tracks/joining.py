"""Joins tracks of several places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from protomark.features.extractor import FEATURE_ARRAYS
from protomark.geometry.camera import Camera
from protomark.tracks.file import Tracks

MAX_ID = 2**63 - 1


def renumbered(tracks: Tracks, last: int) -> Tracks:
    """The tracks with ids above `last`: their own, or all larger by the same number.

    `info["source"]` tells them, too.

    Raises:
        ValueError: there is no room for them below 2^63.
    """
    ids = tracks.landmark_ids
    shift = max(0, last + 1 - int(ids[0])) if len(ids) else 0
    if not shift:
        return tracks
    if int(ids[-1]) > MAX_ID - shift:
        raise ValueError(f"ids up to {ids[-1]} do not fit above {last}: use smaller ids")
    labels = tracks.landmark_of_keypoint
    return replace(
        tracks,
        info={**tracks.info, "source": shifted_ids(tracks.info["source"], shift)},
        landmark_ids=ids + shift,
        landmark_of_keypoint=np.where(labels >= 0, labels + shift, -1),
    )


def shifted_ids(source: dict[str, Any], shift: int) -> dict[str, Any]:
    """Facts on a source, and on the maps in it, with "ids" that are larger by `shift`."""
    out = dict(source)
    if isinstance(ids := source.get("ids"), list):
        out["ids"] = [number + shift for number in ids if isinstance(number, int)]
    if isinstance(maps := source.get("maps"), list):
        out["maps"] = [shifted_ids(one, shift) for one in maps if isinstance(one, dict)]
    return out


def join_tracks(names: Sequence[str], parts: Sequence[Tracks], info: dict[str, Any]) -> Tracks:
    """All keyframes and landmarks of tracks that have none in common.

    Args:
        names: what each part is called, in front of the names of its keyframes.
        parts: tracks of one descriptor, whose ids ascend from part to part (see `renumbered`).
        info: what the result says of itself.
    """
    numbers: dict[Camera, int] = {}
    cameras = []
    for part in parts:
        of = {i: numbers.setdefault(c, len(numbers) + 1) for i, c in part.cameras.items()}
        cameras.append(np.array([of[int(i)] for i in part.keyframe_camera], np.int32))
    lengths = [np.diff(part.offsets) for part in parts]
    arrays = (
        *("cam_from_world", *FEATURE_ARRAYS),
        *("landmark_of_keypoint", "landmark_ids", "landmark_positions"),
    )
    return Tracks(
        descriptor=parts[0].descriptor,
        cameras={number: camera for camera, number in numbers.items()},
        keyframe_names=[
            f"{name}/{keyframe}"
            for name, part in zip(names, parts, strict=True)
            for keyframe in part.keyframe_names
        ],
        keyframe_camera=np.concatenate(cameras),
        offsets=np.concatenate([[0], np.cumsum(np.concatenate(lengths))]).astype(np.int64),
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in arrays},
        info=info,
        input=parts[0].input,
    )
