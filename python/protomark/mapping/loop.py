"""Places seen before: recognised by prototypes of the whole map, and joined."""

from __future__ import annotations

import cv2
import numpy as np

from protomark.localization.absolute_pose import centre
from protomark.mapping.memory import Memory
from protomark.mapping.merging import merge
from protomark.mapping.prediction import REACH, predict
from protomark.mapping.structure import Array, Frame, Ids, Structure
from protomark.mapping.tracking import Tracked, Tracker
from protomark.mapping.triangulation import remember

# Landmarks that the last keyframes see are no revisit.
RECENT = 20
_MIN_INLIERS = 30
# Nor is it one if they are few beside what the frame sees as tracked: repeated texture.
_MIN_SHARE = 0.25
# If what the frame sees is off by less than this many times the largest error under the pose that
# the old landmarks give, there is no drift to take back.
_DRIFT = 3.0


def revisit(
    structure: Structure, memory: Memory, tracker: Tracker, newest: int, max_error: float
) -> tuple[int, bool]:
    """Look for the newest keyframe among landmarks that no recent keyframe saw.

    Where old landmarks give it a pose, those that it sees anew are merged with the old ones. If
    that pose differs from the one that tracking gave, the difference is spread over the keyframes
    since, as a similarity (scale drifts, too), and a global adjustment has to follow.

    Returns:
        Number of landmarks merged, and whether drift was taken back.
    """
    recent = np.zeros(len(structure.positions), bool)
    keyframes = structure.keyframes()
    for i in keyframes[-RECENT:]:
        recent[structure.frames[i].seen] = True
    old = structure.ids
    old = old[~recent[old]]
    frame = structure.frames[newest]
    # Among old landmarks alone: beside their own doubles they would not pass the ratio test.
    found = tracker.relocalize(frame, old)
    if found is not None:
        found = tracker.settle(frame, found.pose, old)
    enough = max(_MIN_INLIERS, _MIN_SHARE * len(frame.seen))
    if found is None or len(found.matches) < enough:
        found = _beside(structure, tracker, newest, old)
    if found is None:
        return 0, False
    matches = found.matches
    drift = _drift(structure, frame, found.pose) > _DRIFT * structure.tolerance(
        frame.camera_id, max_error
    )
    if drift:
        _correct(structure, newest, found.pose, matches.rows, matches.ids)
    seen = frame.landmarks[matches.rows]
    fresh = (seen < 0) & ~np.isin(matches.ids, frame.seen)
    structure.observe(frame, matches.rows[fresh], matches.ids[fresh])
    remember(memory, frame, matches.rows[fresh])
    double = (seen >= 0) & (seen != matches.ids)
    pairs = list(zip(seen[double].tolist(), matches.ids[double].tolist(), strict=True))
    return merge(structure, memory, pairs, max_error, check=not drift), drift


def _beside(structure: Structure, tracker: Tracker, newest: int, old: Ids) -> Tracked | None:
    """The pose that the other side of a gap gives, where this frame has reached it."""
    frame = structure.frames[newest]
    recent = set(structure.keyframes()[-RECENT:])
    others = [other for place, other in enumerate(structure.frames) if place not in recent]
    predicted = predict(others, frame.index, frame.camera_id)
    found = None if predicted is None else tracker.near(frame, predicted, old)
    return None if found is None else tracker.settle(frame, found.pose, old)


def _drift(structure: Structure, frame: Frame, pose: Array) -> float:
    """Median distance in pixels between what a frame sees and where another pose puts it."""
    from protomark.mapping.pose import reprojection_error

    rows = frame.observed
    return float(
        np.median(
            reprojection_error(
                structure.cameras[frame.camera_id],
                frame.keypoints[rows].astype(np.float64),
                structure.positions[frame.landmarks[rows]],
                pose,
            )
        )
    )


def _correct(structure: Structure, newest: int, pose: Array, rows: Ids, ids: Ids) -> None:
    frame = structure.frames[newest]
    rotation = pose[:, :3].T @ frame.pose[:, :3]
    turn = cv2.Rodrigues(rotation)[0][:, 0]
    before, after = centre(frame.pose), centre(pose)
    scale = _scale(structure, frame, pose, rows, ids)
    start = max(_last_witness(structure, newest, ids), _run_start(structure, newest))
    place = np.arange(len(structure.frames))
    shares = np.clip((place - start) / max(newest - start, 1), 0, 1)
    first = np.full(len(structure.positions), len(structure.frames))
    for i, one in enumerate(structure.frames):
        np.minimum.at(first, one.seen, i)
    for i, share in enumerate(shares.tolist()):
        if share == 0:
            continue
        one = structure.frames[i]
        part, grown = cv2.Rodrigues(share * turn)[0], scale**share
        shift = before + share * (after - before)
        mine = np.flatnonzero((first == i) & structure.alive)
        structure.positions[mine] = grown * (structure.positions[mine] - before) @ part.T + shift
        center = grown * part @ (centre(one.pose) - before) + shift
        turned = one.pose[:, :3] @ part.T
        one.pose = np.column_stack([turned, -turned @ center])
    structure.look_again()


def _scale(structure: Structure, frame: Frame, pose: Array, rows: Ids, ids: Ids) -> float:
    """Depth of the old landmarks over that of the new ones at the same keypoints (median)."""
    new = frame.landmarks[rows]
    both = new >= 0
    if both.sum() < 10:
        return 1.0
    deep = structure.positions[ids[both]] @ pose[2, :3] + pose[2, 3]
    shallow = structure.positions[new[both]] @ frame.pose[2, :3] + frame.pose[2, 3]
    return float(np.median(deep / shallow))


def _last_witness(structure: Structure, newest: int, ids: Ids) -> int:
    """The last frame that saw much of what is seen again."""
    wanted = np.zeros(len(structure.positions), bool)
    wanted[ids] = True
    counts = [int(wanted[frame.seen].sum()) for frame in structure.frames[:newest]]
    many = np.flatnonzero(np.array(counts) >= max(1, max(counts) // 2))
    return int(many[-1])


def _run_start(structure: Structure, newest: int) -> int:
    """Where the unbroken run of frames that ends with the newest one begins."""
    frames = structure.frames
    start = newest
    while start > 0 and abs(frames[start].index - frames[start - 1].index) <= REACH:
        start -= 1
    return start
