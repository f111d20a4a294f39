"""Summarises tracks: counts, track lengths and reprojection errors."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.tracks.file import Tracks


def reprojection_errors(tracks: Tracks) -> NDArray[np.float64]:
    """Reprojection errors (n,) in pixels, in the order of `tracks.observations`."""
    rows = tracks.observations
    keyframe = tracks.keyframe_of_keypoint[rows]
    pose = tracks.cam_from_world[keyframe]
    positions = tracks.positions_of(tracks.landmark_of_keypoint[rows])
    local = np.einsum("nij,nj->ni", pose[:, :, :3], positions) + pose[:, :, 3]
    pixels = np.zeros((len(rows), 2))
    for camera_id, camera in tracks.cameras.items():
        taken = tracks.keyframe_camera[keyframe] == camera_id
        pixels[taken] = camera.project(local[taken])
    errors: NDArray[np.float64] = np.linalg.norm(pixels - tracks.keypoints[rows], axis=1)
    return errors


def summarise(tracks: Tracks) -> dict[str, Any]:
    """Counts, track lengths and reprojection errors of tracks, as JSON values."""
    rows = tracks.observations
    lengths = np.unique(tracks.landmark_of_keypoint[rows], return_counts=True)[1]
    errors = reprojection_errors(tracks)
    return {
        "sequence": tracks.info.get("sequence", ""),
        "descriptor": tracks.descriptor,
        "input": tracks.input,
        "bits": tracks.bits,
        "keyframes": len(tracks.keyframe_names),
        "keypoints": len(tracks.keypoints),
        "landmarks": len(tracks.landmark_ids),
        "observations": len(rows),
        **track_figures(lengths, errors),
        "track_length_median": float(np.median(lengths)) if len(lengths) else 0.0,
        "track_length_max": int(lengths.max(initial=0)),
        "poses_refined": bool(tracks.info.get("poses_refined", False)),
    }


def track_figures(lengths: NDArray[np.int64], errors: NDArray[np.float64]) -> dict[str, Any]:
    """Figures of track lengths and of reprojection errors in pixels, as JSON values."""
    return {
        "track_length_mean": float(lengths.mean()) if len(lengths) else 0.0,
        "track_length_histogram": length_histogram(lengths),
        "reprojection_error_mean": float(errors.mean()) if len(errors) else 0.0,
        "reprojection_error_median": float(np.median(errors)) if len(errors) else 0.0,
    }


def length_histogram(lengths: NDArray[np.int64]) -> dict[str, int]:
    """Number of landmarks by number of observations, such as {"2": 17, "4-5": 9}."""
    edges = (2, 3, 4, 6, 8, 12, 16, 24, 32, 64, 128)
    labels = [str(a) if b == a + 1 else f"{a}-{b - 1}" for a, b in pairwise(edges)]
    counts, _ = np.histogram(lengths, (*edges, np.inf))
    return dict(zip([*labels, f"{edges[-1]}+"], counts.tolist(), strict=True))
