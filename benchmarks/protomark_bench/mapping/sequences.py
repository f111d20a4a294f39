"""Sequences of images with their camera and the true trajectory, and trajectory errors."""

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

# Of the project's own sequences, those whose poses a device measured, in metres; the others' poses
# come from an incremental reconstruction of the same images.
_MEASURED = ("hololens", "desk_rpy", "kitchen")
_RECONSTRUCTED = ("viking", "conch", "seneca", "caliterra", "toy", "castle", "kitti07")


class FirstImages(ImageFolder):
    """A folder of images of which only the first `frames` count, 0 for all."""

    def __init__(self, path: Path, every: int, frames: int) -> None:
        super().__init__(path, every)
        self._names = self._names[: frames or None]
        self._times = self._times[: frames or None]


@dataclass(frozen=True)
class ImageSequence:
    """Images in their order, of one camera, and where they were taken.

    Attributes:
        name: of its folder.
        source: the images that take part.
        available: how many images the folder holds.
        camera: their camera.
        poses: image name -> (3, 4) true cam_from_world, of those that have one.
    """

    name: str
    source: ImageFolder
    available: int
    camera: Camera
    poses: dict[str, NDArray[np.float64]]

    @property
    def truth(self) -> str:
        """Where the true poses come from, for tables."""
        if self.name in _MEASURED:
            return "measured, metres"
        return "SfM, its own unit" if self.name in _RECONSTRUCTED else "as given"

    @property
    def centers(self) -> dict[str, list[float]]:
        """Image name -> true camera centre, x, y, z."""
        return {name: camera_centers(pose).tolist() for name, pose in self.poses.items()}

    @property
    def extent(self) -> float:
        """Diagonal of the box around the true camera centres."""
        return float(np.linalg.norm(np.ptp(list(self.centers.values()), axis=0)))


def open_sequence(folder: Path, every: int = 1, frames: int = 0) -> ImageSequence:
    """A folder that holds images/ and sparse/.

    Args:
        folder: the folder.
        every: take every n-th image only.
        frames: take the first so many of those only; 0: all.

    Raises:
        FileNotFoundError: images or model are missing.
        ValueError: there are several cameras, or fewer than three of the images have a pose.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; a sequence holds images/ and sparse/")
    images = folder / "images" if (folder / "images").is_dir() else folder
    source = FirstImages(images, every, frames)
    available = len(ImageFolder(images))
    path = find_model(folder)
    model = read_model(path)
    true = dict(zip(model.names, model.cam_from_world, strict=True))
    poses = {name: true[name] for name in source.names() if name in true}
    if len(poses) < 3:
        raise ValueError(
            f"{folder}: {len(poses)} of {len(source)} images have a pose in {path}, three are "
            "needed to compare trajectories; are the names the same?"
        )
    camera = read_cameras(str(path)).find("", *source.size())
    return ImageSequence(folder.resolve().name, source, available, camera, poses)


def open_sequences(folders: Sequence[Path], every: int, frames: int) -> list[ImageSequence]:
    """All of them; see `open_sequence`.

    Raises:
        ValueError: two have one name.
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
        centers: image name -> estimated camera centre.
        true: image name -> true camera centre.
        among: names that count; None: all.

    Returns:
        None where fewer than three images, or images of one place, have both.
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
