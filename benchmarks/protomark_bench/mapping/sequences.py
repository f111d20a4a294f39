"""Opens image sequences with camera and true trajectory, and measures trajectory errors."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.camera import Camera
from protomark.geometry.camera_files import read_cameras
from protomark.geometry.colmap import find_model, read_model
from protomark.geometry.pose import camera_centers
from protomark.mapping.source import ImageFolder
from protomark_bench.trajectory import trajectory_error

# The project's sequences with poses that a device measured in metres, and those with poses from an
# incremental reconstruction of the same images.
_MEASURED = ("hololens", "desk_rpy", "kitchen")
_RECONSTRUCTED = ("viking", "conch", "seneca", "caliterra", "toy", "castle", "kitti07")


class FirstImages(ImageFolder):
    """The first images of a folder; all if `frames` is 0."""

    def __init__(self, path: Path, every: int, frames: int) -> None:
        super().__init__(path, every)
        self._names = self._names[: frames or None]
        self._times = self._times[: frames or None]


@dataclass(frozen=True)
class ImageSequence:
    """Images of one camera in order, and their true poses.

    Attributes:
        name: name of the folder.
        source: the images of the runs.
        available: number of images in the folder.
        camera: the camera of all images.
        poses: true cam_from_world (3, 4) by image name, as far as it exists.
    """

    name: str
    source: ImageFolder
    available: int
    camera: Camera
    poses: dict[str, NDArray[np.float64]]

    @property
    def truth(self) -> str:
        """Origin of the true poses, for tables."""
        if self.name in _MEASURED:
            return "measured, metres"
        return "SfM, its own unit" if self.name in _RECONSTRUCTED else "as given"

    @property
    def centers(self) -> dict[str, list[float]]:
        """True camera centres x, y, z by image name."""
        return {name: camera_centers(pose).tolist() for name, pose in self.poses.items()}

    @property
    def extent(self) -> float:
        """Diagonal of the box around the true camera centres."""
        return float(np.linalg.norm(np.ptp(list(self.centers.values()), axis=0)))


def open_sequence(folder: Path, every: int = 1, frames: int = 0) -> ImageSequence:
    """Open a folder with images/ and sparse/.

    Args:
        folder: the folder.
        every: take every n-th image only.
        frames: take only so many of these images; 0: all.

    Raises:
        FileNotFoundError: images or model are missing.
        ValueError: there are several cameras, or fewer than three of the images have a pose.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder: name one with images/ and sparse/")
    images = folder / "images" if (folder / "images").is_dir() else folder
    source = FirstImages(images, every, frames)
    available = len(ImageFolder(images))
    path = find_model(folder)
    model = read_model(path)
    true = dict(zip(model.names, model.cam_from_world, strict=True))
    poses = {name: true[name] for name in source.names() if name in true}
    if len(poses) < 3:
        raise ValueError(
            f"{folder}: {len(poses)} of {len(source)} images have a pose in {path}, but the "
            "comparison of trajectories needs three: give a model with the same image names"
        )
    camera = read_cameras(str(path)).find("", *source.size())
    return ImageSequence(folder.resolve().name, source, available, camera, poses)


def open_sequences(folders: Sequence[Path], every: int, frames: int) -> list[ImageSequence]:
    """Open several sequences, see `open_sequence`.

    Raises:
        ValueError: two have the same name.
    """
    found = [open_sequence(folder, every, frames) for folder in folders]
    names = [s.name for s in found]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"two sequences are named {name}: rename the folder of one")
    return found


def error(
    centers: dict[str, list[float]],
    true: dict[str, list[float]],
    among: Collection[str] | None = None,
) -> float | None:
    """Root mean squared distance of camera centres after the best similarity (as evo's -as).

    Args:
        centers: estimated camera centres by image name.
        true: true camera centres by image name.
        among: image names that count; None: all.

    Returns:
        None if fewer than three images, or images of one position, have both.
    """
    names = [n for n in centers if n in true and (among is None or n in among)]
    if len(names) < 3:
        return None
    try:
        found = trajectory_error(
            np.array([centers[n] for n in names]), np.array([true[n] for n in names])
        )
    except ValueError:
        return None
    return found.rmse
