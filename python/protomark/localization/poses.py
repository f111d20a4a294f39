"""Reading and writing poses by image: COLMAP's images.txt and TUM trajectories."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def read_poses(path: Path) -> dict[str, NDArray[np.float64]]:
    """Poses (3, 4) cam_from_world by image name, or by time stamp where the file is a trajectory.

    Args:
        path: a folder with a COLMAP model, an images.txt, or a TUM trajectory (a line a pose:
            time, position and quaternion x y z w of the camera in the world).

    Raises:
        FileNotFoundError: there is nothing at `path`.
        ValueError: the file holds no poses, or a broken one.
    """
    if path.is_dir():
        from protomark.tracks.colmap import find_model, model_of, read_reconstruction

        folder = find_model(path)
        model = model_of(read_reconstruction(folder), folder)
        return dict(zip(model.names, model.cam_from_world, strict=True))
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file of poses")
    poses: dict[str, NDArray[np.float64]] = {}
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            if len(words) == 10:  # images.txt; the line of its points is a multiple of three long
                quaternion, shift = np.array(words[1:5], float), np.array(words[5:8], float)
                rotation = _rotation(quaternion)
                poses[words[9]] = np.column_stack([rotation, shift])
            elif len(words) == 8 and _numeric(words):  # TUM
                quaternion = np.array([words[7], *words[4:7]], float)
                rotation, center = _rotation(quaternion).T, np.array(words[1:4], float)
                poses[words[0]] = np.column_stack([rotation, -rotation @ center])
        except ValueError as error:
            raise ValueError(f"{path}, line {number}: {error}") from None
    if not poses:
        raise ValueError(
            f"{path}: no poses in it; give a COLMAP images.txt, a folder with a model, or a TUM "
            "trajectory"
        )
    return poses


def pose_of(poses: Mapping[str, NDArray[np.float64]], image: str) -> NDArray[np.float64] | None:
    """The pose of an image by its name, its name without folders, or its time stamp."""
    path = Path(image)
    for key in (image, path.name, path.stem):
        if key in poses:
            return poses[key]
    try:
        time = float(path.stem)
    except ValueError:
        return None
    for key, pose in poses.items():
        try:
            if float(key) == time:
                return pose
        except ValueError:
            continue
    return None


def images_txt(poses: Mapping[str, NDArray[np.float64]], camera_ids: Mapping[str, int]) -> str:
    """COLMAP's images.txt with these poses (3, 4) by name, without keypoints."""
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and an empty line for the points"]
    for i, (name, pose) in enumerate(poses.items(), 1):
        numbers = " ".join(f"{x:.12g}" for x in (*_quaternion(pose[:, :3]), *pose[:, 3]))
        lines += [f"{i} {numbers} {camera_ids[name]} {name}", ""]
    return "\n".join(lines) + "\n"


def _numeric(words: list[str]) -> bool:
    try:
        return len([float(word) for word in words]) > 0
    except ValueError:
        return False


def _rotation(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """w, x, y, z -> (3, 3)."""
    norm = np.linalg.norm(quaternion)
    if not np.isfinite(norm) or abs(norm - 1) > 0.05:
        raise ValueError(f"quaternion {quaternion.tolist()} is not of length 1")
    w, *v = quaternion / norm
    x = np.array(v)
    cross = np.array([[0, -x[2], x[1]], [x[2], 0, -x[0]], [-x[1], x[0], 0]])
    return np.asarray(np.eye(3) + 2 * w * cross + 2 * cross @ cross)


def _quaternion(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) -> w, x, y, z with w >= 0: the eigenvector of Bar-Itzhack (2000), well conditioned."""
    r = rotation
    k = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], 0, 0, 0],
            [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], 0, 0],
            [r[0, 2] - r[2, 0], r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], 0],
            [
                r[1, 0] - r[0, 1],
                r[2, 0] + r[0, 2],
                r[2, 1] + r[1, 2],
                r[2, 2] - r[0, 0] - r[1, 1],
            ],
        ]
    )
    _, vectors = np.linalg.eigh(k)  # the lower triangle counts
    q = vectors[:, -1]
    return np.asarray(q if q[0] >= 0 else -q)
