"""Writes COLMAP models, as COLMAP, nerfstudio and gsplat read them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.files import replacing_folder
from protomark.geometry.colmap import (
    add_points,
    find_model,
    new_reconstruction,
    quiet,
    read_reconstruction,
)
from protomark.tracks.file import Tracks


def reconstruction_of(source: Path, tracks: Tracks | None, images: Path | None = None) -> Any:
    """The `pycolmap.Reconstruction` of a folder of `protomark map` or of tracks.

    Raises:
        FileNotFoundError: an image is missing from the folder `images`.
        ValueError: the source is a map file, which holds no poses.
    """
    if tracks is not None:
        reconstruction = _of_tracks(tracks)
    elif source.is_dir():
        reconstruction = read_reconstruction(find_model(source))
    else:
        raise ValueError(
            f"{source} holds landmarks only, no cameras' poses: give the folder of "
            "`protomark map`, or tracks"
        )
    if images is not None:
        for name in sorted(image.name for image in reconstruction.images.values()):
            if not (images / name).is_file():
                raise FileNotFoundError(f"{images / name}: no such image to take colours of")
        with quiet():
            reconstruction.extract_colors_for_all_images(str(images))
    return reconstruction


def _of_tracks(tracks: Tracks) -> Any:
    counts = np.diff(tracks.offsets)
    images = [
        (
            i + 1,
            name,
            int(tracks.keyframe_camera[i]),
            tracks.keypoints[tracks.keypoints_of(i)],
            pose,
        )
        for i, (name, pose) in enumerate(
            zip(tracks.keyframe_names, tracks.cam_from_world, strict=True)
        )
    ]
    reconstruction = new_reconstruction(tracks.cameras, images)
    rows = tracks.observations
    keyframes, landmarks = tracks.keyframe_of_keypoint[rows], tracks.landmark_of_keypoint[rows]
    # COLMAP's points are seen by an image once.
    pairs = np.column_stack([keyframes, landmarks])
    first = np.sort(np.unique(pairs, axis=0, return_index=True)[1])
    rows, keyframes, landmarks = rows[first], keyframes[first], landmarks[first]
    starts = np.cumsum(counts) - counts
    add_points(
        reconstruction,
        keyframes + 1,
        rows - starts[keyframes],
        landmarks,
        tracks.positions_of(np.unique(landmarks)),
    )
    return reconstruction


def coloured_points(
    reconstruction: Any,
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.uint8]]:
    """Positions (p, 3), numbers of observations (p,) and colours (p, 3) of the points."""
    points = [reconstruction.points3D[i] for i in sorted(reconstruction.points3D)]
    return (
        np.array([p.xyz for p in points], np.float64).reshape(-1, 3),
        np.array([p.track.length() for p in points], np.int64),
        np.array([p.color for p in points], np.uint8).reshape(-1, 3),
    )


def write_colmap(reconstruction: Any, output: Path) -> dict[str, Any]:
    """Write a binary model to sparse/0/ in a folder, where other programs look for it."""
    output.parent.mkdir(parents=True, exist_ok=True)
    with quiet(), replacing_folder(output) as folder:
        (folder / "sparse" / "0").mkdir(parents=True)
        reconstruction.update_point_3d_errors()
        reconstruction.write(str(folder / "sparse" / "0"))
    return {
        "images": reconstruction.num_reg_images(),
        "cameras": len(reconstruction.cameras),
        "landmarks": len(reconstruction.points3D),
    }
