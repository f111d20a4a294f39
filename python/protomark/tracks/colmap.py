"""COLMAP sparse models and cameras; the only module that imports pycolmap.

Everything else that needs pycolmap imports it from here: `from protomark.tracks.colmap import
pycolmap`. pycolmap carries a zlib of its own, and Python's `zlib` breaks for the whole process if
it is first imported after pycolmap, so the order of the two imports below matters.
"""

from __future__ import annotations

import zlib  # noqa: F401  (must come before pycolmap, see above)

# isort: split
import contextlib
import os
import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.tracks.file import Camera

try:
    import pycolmap
except ModuleNotFoundError:
    raise ModuleNotFoundError(
        "reading COLMAP models needs pycolmap: pip install pycolmap"
    ) from None

__all__ = [
    "Model",
    "find_model",
    "pycolmap",
    "quiet",
    "read_cameras",
    "read_model",
    "read_reconstruction",
]

_FILES = ("cameras", "images")


@dataclass
class Model:
    """Cameras and the images that have a pose, in the order of their names.

    Attributes:
        cameras: COLMAP camera id -> camera.
        names: m image names, in natural order (img2 before img10): the order of capture.
        image_ids: (m,) int64, COLMAP image ids.
        camera_ids: (m,) int32, camera of each image.
        cam_from_world: (m, 3, 4) float64.
        unposed: names of images in the model that have no pose.
    """

    cameras: dict[int, Camera]
    names: list[str]
    image_ids: NDArray[np.int64]
    camera_ids: NDArray[np.int32]
    cam_from_world: NDArray[np.float64]
    unposed: list[str]

    @property
    def centers(self) -> NDArray[np.float64]:
        """(m, 3) float64, camera centres in the world."""
        rotation, translation = self.cam_from_world[:, :, :3], self.cam_from_world[:, :, 3]
        centers: NDArray[np.float64] = -np.einsum("mji,mj->mi", rotation, translation)
        return centers


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep COLMAP's log off the terminal; what matters comes as exceptions."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


def find_model(folder: Path) -> Path:
    """The sparse model of a sequence folder: sparse/, sparse/0/ or the folder itself.

    Raises:
        FileNotFoundError: none of them holds a model.
    """
    for candidate in (folder / "sparse", folder / "sparse" / "0", folder):
        if _suffix(candidate):
            return candidate
    raise FileNotFoundError(
        f"{folder}: no COLMAP model (cameras and images, .bin or .txt) in sparse/ or sparse/0/, "
        "name it with --model"
    )


def _suffix(path: Path) -> str | None:
    for suffix in (".bin", ".txt"):
        if all((path / f"{name}{suffix}").is_file() for name in _FILES):
            return suffix
    return None


def read_reconstruction(path: Path) -> Any:
    """Read a sparse model, text or binary, with or without a file of points.

    Raises:
        FileNotFoundError: there is no model at `path`.
        ValueError: the model is broken.
    """
    suffix = _suffix(path)
    if suffix is None:
        raise FileNotFoundError(
            f"{path}: no COLMAP model here (it needs cameras and images, .bin or .txt)"
        )
    for name in _FILES:
        if (path / f"{name}{suffix}").stat().st_size == 0:
            raise ValueError(f"{path / (name + suffix)}: empty file, export the COLMAP model anew")
    with quiet(), tempfile.TemporaryDirectory(prefix="protomark-") as temporary:
        source = path
        if not (path / f"points3D{suffix}").is_file():
            source = Path(temporary)
            for file in path.iterdir():
                if file.is_file() and file.suffix == suffix:
                    os.symlink(file.resolve(), source / file.name)
            (source / f"points3D{suffix}").write_bytes(bytes(8) if suffix == ".bin" else b"")
        try:
            return pycolmap.Reconstruction(str(source))
        except (ValueError, IndexError, KeyError, RuntimeError, MemoryError) as error:
            reason = re.sub(r"^\[.*?\] ", "", str(error))[:120]
            raise ValueError(
                f"{path}: broken COLMAP model ({reason}), export it anew from COLMAP"
            ) from None


def read_model(path: Path) -> Model:
    """Cameras and poses of a sparse model.

    Raises:
        FileNotFoundError: there is no model at `path`.
        ValueError: the model is broken, has fewer than two images with a pose, or all its cameras
            stand at one place, so that nothing can be triangulated.
    """
    model = model_of(read_reconstruction(path), path)
    if len(model.names) < 2:
        raise ValueError(
            f"{path}: {len(model.names)} image(s) with a pose, at least two are needed; "
            "is this the right model?"
        )
    if np.ptp(model.centers, axis=0).max() <= 1e-9 * max(1.0, np.abs(model.centers).max()):
        raise ValueError(
            f"{path}: all cameras stand at the same place, so no landmark can be triangulated"
        )
    return model


def read_cameras(path: Path) -> dict[int, Camera]:
    """Cameras of a COLMAP cameras.txt, or of a model's folder or any file in it.

    Raises:
        ValueError: a line is not a camera's, or the model is broken.
    """
    if path.is_dir() and (path / "cameras.txt").is_file():
        path = path / "cameras.txt"
    if path.suffix != ".txt":
        folder = path if path.is_dir() else path.parent
        return model_of(read_reconstruction(find_model(folder)), folder).cameras
    cameras = {}
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            params = tuple(float(word) for word in words[4:])
            camera = Camera(words[1], int(words[2]), int(words[3]), params)
            if not _camera(camera).mean_focal_length() > 0:
                raise ValueError
        except (ValueError, IndexError, KeyError, RuntimeError, OverflowError, TypeError):
            raise ValueError(
                f"{path}, line {number}: not a COLMAP camera (id, model, width, height, parameters)"
            ) from None
        cameras[int(words[0]) if words[0].isdigit() else number] = camera
    return cameras


def model_of(reconstruction: Any, path: Path) -> Model:
    """The cameras and poses of a pycolmap reconstruction that was read from `path`."""
    cameras = {}
    for camera_id, camera in reconstruction.cameras.items():
        ours = Camera(
            camera.model.name, camera.width, camera.height, tuple(float(p) for p in camera.params)
        )
        if not np.isfinite(ours.params).all() or camera.mean_focal_length() <= 0:
            raise ValueError(f"{path}: camera {camera_id} has no valid focal length")
        cameras[int(camera_id)] = ours
    images = sorted(reconstruction.images.values(), key=lambda image: natural_key(image.name))
    posed = [image for image in images if image.has_pose]
    poses = np.array([i.cam_from_world().matrix() for i in posed], np.float64).reshape(-1, 3, 4)
    for image, pose in zip(posed, poses, strict=True):
        if not np.isfinite(pose).all() or abs(np.linalg.det(pose[:, :3]) - 1) > 1e-3:
            raise ValueError(f"{path}: the pose of image {image.name} is not a rigid motion")
    return Model(
        cameras=cameras,
        names=[image.name for image in posed],
        image_ids=np.array([image.image_id for image in posed], np.int64),
        camera_ids=np.array([image.camera_id for image in posed], np.int32),
        cam_from_world=poses,
        unposed=[image.name for image in images if not image.has_pose],
    )


def natural_key(name: str) -> list[tuple[int, str]]:
    """Sort key under which frame2 comes before frame10."""
    return [(int(p), "") if p.isdigit() else (-1, p) for p in re.split(r"(\d+)", name)]


def _camera(camera: Camera) -> Any:
    """As pycolmap has it, which reads past the end of too few parameters: ValueError."""
    camera.check_params()
    try:
        ours = pycolmap.Camera(camera.as_dict())
    except (RuntimeError, ValueError):
        raise ValueError(f"this pycolmap does not know camera model {camera.model}") from None
    if not ours.verify_params():
        raise ValueError(f"{camera.params} are no parameters of camera model {camera.model}")
    return ours


def rays(camera: Camera, pixels: NDArray[Any]) -> NDArray[np.float64]:
    """Undistort: pixels (n, 2) -> (n, 2) x / z and y / z, NaN where the camera model fails."""
    out = np.full((len(pixels), 2), np.nan)
    if len(pixels):
        out[:] = np.asarray(_camera(camera).cam_from_img(np.asarray(pixels, np.float64)))
    return out


def project(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Project points (n, 3) in camera coordinates -> pixels (n, 2), NaN behind the camera."""
    out = np.full((len(points), 2), np.nan)
    front = points[:, 2] > 0
    if front.any():
        out[front] = np.asarray(_camera(camera).img_from_cam(np.asarray(points[front], np.float64)))
    return out


@lru_cache(maxsize=64)
def focal_length(camera: Camera) -> float:
    """Mean focal length in pixels."""
    return float(_camera(camera).mean_focal_length())
