"""Closes loops: recognises places seen before by the prototypes of the whole map."""

from __future__ import annotations

import numpy as np

from protomark.extras import optional
from protomark.geometry.pose import camera_centers
from protomark.mapping.frame import Array, Frame, Ids
from protomark.mapping.merging import merge_duplicates
from protomark.mapping.prediction import MAX_STEP, predict
from protomark.mapping.structure import Structure
from protomark.mapping.tracking import TrackedPose, Tracker
from protomark.mapping.triangulation import update_prototypes

# A revisit is by landmarks that the latest keyframes do not observe, at least so many, and at least
# this share of those that the frame tracks: fewer are repeated texture.
RECENT = 20
_MIN_INLIERS = 30
_MIN_SHARE = 0.25
# Drift is corrected if the tracked landmarks are off by more than this multiple of the largest
# error under the pose that the old landmarks give.
_DRIFT = 3.0


def close_loop(tracker: Tracker, newest: int) -> tuple[int, bool]:
    """Search for the newest keyframe among landmarks that no recent keyframe observes.

    If old landmarks give it a pose, the new landmarks that it observes are merged with the old
    ones. If that pose differs from the tracked one, the difference is distributed over the frames
    since then as a similarity (scale drifts, too), and a global adjustment has to follow.

    Returns:
        Number of merged landmarks, and whether drift was corrected.
    """
    structure, memory = tracker.structure, tracker.memory
    recent = np.zeros(len(structure.positions), bool)
    keyframes = structure.keyframes()
    for i in keyframes[-RECENT:]:
        recent[structure.frames[i].seen] = True
    old = structure.ids
    old = old[~recent[old]]
    frame = structure.frames[newest]
    # Only old landmarks are searched: beside their duplicates they would not pass the ratio test.
    found = tracker.relocalize(frame, old)
    if found is not None:
        found = tracker.track_local_map(frame, found.pose, old)
    enough = max(_MIN_INLIERS, _MIN_SHARE * len(frame.seen))
    if found is None or len(found.matches) < enough:
        found = _across_gap(tracker, newest, old)
    if found is None:
        return 0, False
    matches = found.matches
    off = structure.median_error(found.pose, frame, frame.observed, frame.seen)
    drift = off > _DRIFT * structure.max_error(frame.camera_id)
    if drift:
        _correct_drift(structure, newest, found.pose, matches.rows, matches.ids)
    seen = frame.landmarks[matches.rows]
    fresh = (seen < 0) & ~np.isin(matches.ids, frame.seen)
    structure.observe(frame, matches.rows[fresh], matches.ids[fresh])
    update_prototypes(memory, frame, matches.rows[fresh])
    duplicate = (seen >= 0) & (seen != matches.ids)
    pairs = list(zip(seen[duplicate].tolist(), matches.ids[duplicate].tolist(), strict=True))
    return merge_duplicates(structure, memory, pairs, check=not drift), drift


def _across_gap(tracker: Tracker, newest: int, old: Ids) -> TrackedPose | None:
    """The pose that the frames on the other side of a gap in the input predict, refined."""
    structure = tracker.structure
    frame = structure.frames[newest]
    recent = set(structure.keyframes()[-RECENT:])
    others = [other for i, other in enumerate(structure.frames) if i not in recent]
    predicted = predict(others, frame.index, frame.camera_id)
    found = None if predicted is None else tracker.track_among(frame, predicted, old)
    return None if found is None else tracker.track_local_map(frame, found.pose, old)


def _correct_drift(structure: Structure, newest: int, pose: Array, rows: Ids, ids: Ids) -> None:
    """Rotate, move and scale the frames since the last visit, each by its share."""
    cv2 = optional("cv2")
    frame = structure.frames[newest]
    rotation = pose[:, :3].T @ frame.pose[:, :3]
    turn = cv2.Rodrigues(rotation)[0][:, 0]
    before, after = camera_centers(frame.pose), camera_centers(pose)
    scale = _scale(structure, frame, pose, rows, ids)
    start = max(_last_visit(structure, newest, ids), _run_start(structure, newest))
    index = np.arange(len(structure.frames))
    shares = np.clip((index - start) / max(newest - start, 1), 0, 1)
    first = np.full(len(structure.positions), len(structure.frames))
    for i, one in enumerate(structure.frames):
        np.minimum.at(first, one.seen, i)
    for i, share in enumerate(shares.tolist()):
        if share == 0:
            continue
        one = structure.frames[i]
        part, stretch = cv2.Rodrigues(share * turn)[0], scale**share
        shift = before + share * (after - before)
        ids_first_seen = np.flatnonzero((first == i) & structure.existing)
        local = structure.positions[ids_first_seen] - before
        structure.positions[ids_first_seen] = stretch * local @ part.T + shift
        center = stretch * part @ (camera_centers(one.pose) - before) + shift
        turned = one.pose[:, :3] @ part.T
        one.pose = np.column_stack([turned, -turned @ center])
    structure.recompute_views()


def _scale(structure: Structure, frame: Frame, pose: Array, rows: Ids, ids: Ids) -> float:
    """Median depth of the old landmarks over that of the new ones at the same keypoints."""
    new = frame.landmarks[rows]
    both = new >= 0
    if both.sum() < 10:
        return 1.0
    old_depth = structure.positions[ids[both]] @ pose[2, :3] + pose[2, 3]
    new_depth = structure.positions[new[both]] @ frame.pose[2, :3] + frame.pose[2, 3]
    return float(np.median(old_depth / new_depth))


def _last_visit(structure: Structure, newest: int, ids: Ids) -> int:
    """Index of the last frame that observed many of the landmarks which are observed again."""
    revisited = np.zeros(len(structure.positions), bool)
    revisited[ids] = True
    counts = np.array([revisited[frame.seen].sum() for frame in structure.frames[:newest]])
    return int(np.flatnonzero(counts >= max(1, counts.max() // 2))[-1])


def _run_start(structure: Structure, newest: int) -> int:
    """Index of the first frame of the gapless run that ends with the newest one."""
    frames = structure.frames
    start = newest
    while start > 0 and abs(frames[start].index - frames[start - 1].index) <= MAX_STEP:
        start -= 1
    return start
