"""Reads COLMAP models; the only module that imports pycolmap.

Other modules import it from here: `from protomark.geometry.colmap import pycolmap`. pycolmap
contains a zlib of its own, and Python's `zlib` fails in the whole process if it is first imported
after pycolmap, so the order of the two imports below matters.
"""

from __future__ import annotations

import zlib  # noqa: F401  (must come before pycolmap, see above)

# isort: split
import contextlib
import os
import re
import signal
import tempfile
import threading
import warnings
from codecs import BOM_UTF8
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.extras import optional
from protomark.files import natural_key
from protomark.geometry.camera import Camera
from protomark.geometry.pose import camera_centers
from protomark.geometry.pose_files import check_images_txt

# pycolmap takes SIGTERM for itself, to print a stack trace.
_on_sigterm = signal.getsignal(signal.SIGTERM)
pycolmap = optional("pycolmap")
if _on_sigterm is not None and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGTERM, _on_sigterm)

_FILES = ("cameras", "images")


@dataclass
class ColmapModel:
    """Cameras of a sparse model, and its images with a pose, in natural order of their names."""

    cameras: dict[int, Camera]  # cameras by COLMAP's id
    names: list[str]  # m image names (img2 comes before img10)
    image_ids: NDArray[np.int64]  # (m,) int64, COLMAP image ids
    camera_ids: NDArray[np.int32]  # (m,) int32, camera of each image
    cam_from_world: NDArray[np.float64]  # (m, 3, 4) float64
    unposed: list[str]  # names of the images without a pose

    @property
    def centers(self) -> NDArray[np.float64]:
        """(m, 3) float64, camera centres in the world."""
        return camera_centers(self.cam_from_world)

    def where(self, keep: Sequence[bool]) -> ColmapModel:
        """The model with the images for which `keep` (m,) is true."""
        rows = np.flatnonzero(keep)
        return replace(
            self,
            names=[self.names[i] for i in rows],
            image_ids=self.image_ids[rows],
            camera_ids=self.camera_ids[rows],
            cam_from_world=self.cam_from_world[rows],
        )

    def check_for_triangulation(self, path: Path) -> None:
        """Raise ValueError unless two images have poses at different positions."""
        if len(self.names) < 2:
            raise ValueError(
                f"{path}: {len(self.names)} image(s) have a pose, but triangulation needs two: "
                "give the right model"
            )
        if np.ptp(self.centers, axis=0).max() <= 1e-9 * max(1.0, np.abs(self.centers).max()):
            raise ValueError(
                f"{path}: all cameras have the same position, so no landmark can be triangulated: "
                "give images of a moving camera"
            )


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Silence COLMAP's log; failures still raise exceptions."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


def find_model(folder: Path) -> Path:
    """The sparse model in a sequence folder: sparse/, sparse/0/ or the folder itself.

    Raises:
        FileNotFoundError: none of them holds a model.
    """
    for candidate in (folder / "sparse", folder / "sparse" / "0", folder):
        if is_model(candidate):
            break
    else:
        raise FileNotFoundError(
            f"{folder} has no COLMAP model (cameras and images, .bin or .txt) in sparse/ or "
            "sparse/0/: name the folder that has one (for `protomark tracks`: --model)"
        )
    others = [p for p in sorted((folder / "sparse").glob("*")) if p != candidate and is_model(p)]
    if others:
        names = ", ".join(str(p) for p in others[:5])
        warnings.warn(f"{candidate} is read, other models exist: {names}", stacklevel=2)
    return candidate


def is_model(folder: Path) -> bool:
    """Whether a folder holds the files of a sparse model."""
    return _suffix(folder) is not None


def _suffix(path: Path) -> str | None:
    for suffix in (".bin", ".txt"):
        if all((path / f"{name}{suffix}").is_file() for name in _FILES):
            return suffix
    return None


def read_reconstruction(path: Path) -> Any:
    """Read a sparse model, text or binary, with or without a file of points.

    Returns:
        A `pycolmap.Reconstruction`.

    Raises:
        FileNotFoundError: there is no model at `path`.
        ValueError: the model is broken.
    """
    suffix = _suffix(path)
    if suffix is None:
        raise FileNotFoundError(
            f"{path} holds no COLMAP model: name a folder with cameras and images, .bin or .txt"
        )
    for name in _FILES:
        if (path / f"{name}{suffix}").stat().st_size == 0:
            raise ValueError(f"{path / (name + suffix)}: empty file, export the COLMAP model anew")
    if suffix == ".txt":
        check_images_txt(path / "images.txt")
    elif all((path / f"{name}.txt").is_file() for name in _FILES):
        warnings.warn(f"{path}: the binary model is read, not the text beside it", stacklevel=2)
    with quiet(), tempfile.TemporaryDirectory(prefix="protomark-") as temporary:
        source = Path(temporary)
        for file in path.iterdir():
            if not file.is_file() or file.suffix != suffix:
                continue
            if suffix == ".txt" and _has_bom(file):
                (source / file.name).write_bytes(file.read_bytes()[len(BOM_UTF8) :])
            else:
                os.symlink(file.resolve(), source / file.name)
        if not (source / f"points3D{suffix}").exists():
            (source / f"points3D{suffix}").write_bytes(bytes(8) if suffix == ".bin" else b"")
        try:
            return pycolmap.Reconstruction(str(source))
        except (ValueError, IndexError, KeyError, RuntimeError, MemoryError) as error:
            reason = re.sub(r"^\[.*?\] ", "", str(error))[:120]
            raise ValueError(
                f"{path}: broken COLMAP model ({reason}), export it anew from COLMAP"
            ) from None


def _has_bom(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(BOM_UTF8)) == BOM_UTF8


def read_observations(
    path: Path,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """The observations of a sparse model, o of them.

    Returns:
        (o,) int64 point ids; (o,) int64 which image, from 0 on; (o, 2) float64 pixels; and (o, 2)
        float64 width and height of the image.

    Raises:
        FileNotFoundError, ValueError: see `read_reconstruction`.
    """
    reconstruction = read_reconstruction(path)
    ids: list[int] = []
    images: list[int] = []
    pixels: list[list[float]] = []
    sizes: list[tuple[int, int]] = []
    for number, image in enumerate(reconstruction.images.values()):
        seen = [p for p in image.points2D if p.has_point3D()]
        camera = reconstruction.cameras[image.camera_id]
        ids += [p.point3D_id for p in seen]
        images += [number] * len(seen)
        pixels += [p.xy.tolist() for p in seen]
        sizes += [(camera.width, camera.height)] * len(seen)
    return (
        np.array(ids, np.int64),
        np.array(images, np.int64),
        np.array(pixels, np.float64).reshape(-1, 2),
        np.array(sizes, np.float64).reshape(-1, 2),
    )


def landmarks_by_image(path: Path) -> dict[str, NDArray[np.int64]]:
    """The point ids (n,) that each image of a sparse model sees, by its name."""
    return {
        image.name: np.array([p.point3D_id for p in image.points2D if p.has_point3D()], np.int64)
        for image in read_reconstruction(path).images.values()
    }


def new_reconstruction(
    cameras: Mapping[int, Camera],
    images: Iterable[tuple[int, str, int, NDArray[Any], NDArray[np.float64]]],
) -> Any:
    """A `pycolmap.Reconstruction` of cameras and posed images, without points.

    Args:
        cameras: cameras by id.
        images: id, name, camera id, keypoints (n, 2) in pixels and cam_from_world of each image.
    """
    reconstruction = pycolmap.Reconstruction()
    for camera_id, camera in cameras.items():
        reconstruction.add_camera_with_trivial_rig(
            pycolmap.Camera({**camera.as_dict(), "camera_id": camera_id})
        )
    for image_id, name, camera_id, keypoints, pose in images:
        image = pycolmap.Image(
            name=name,
            camera_id=camera_id,
            image_id=image_id,
            keypoints=np.asarray(keypoints, np.float64).reshape(-1, 2),
        )
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    return reconstruction


def add_points(
    reconstruction: Any,
    image_ids: NDArray[np.int64],
    rows: NDArray[np.int64],
    point_ids: NDArray[np.int64],
    positions: NDArray[np.float64],
) -> None:
    """Add the points of o observations to a `pycolmap.Reconstruction` that has their images.

    Args:
        reconstruction: changes.
        image_ids: (o,) the image of each observation.
        rows: (o,) the keypoint in that image.
        point_ids: (o,) the point.
        positions: (p, 3) positions of the points, in ascending order of their ids.
    """
    # Access through the reconstruction takes longer than everything else per observation.
    by_id = {int(i): reconstruction.images[int(i)] for i in np.unique(image_ids)}
    order = np.argsort(point_ids, kind="stable")
    ids, starts = np.unique(point_ids[order], return_index=True)
    images, keypoints = image_ids[order].tolist(), rows[order].tolist()
    ends = [*starts.tolist(), len(images)][1:]
    for point_id, position, a, b in zip(
        ids.tolist(), positions, starts.tolist(), ends, strict=True
    ):
        elements = [pycolmap.TrackElement(images[k], keypoints[k]) for k in range(a, b)]
        point = pycolmap.Point3D(xyz=position, track=pycolmap.Track(elements))
        reconstruction.add_point3D_with_id(point_id, point)
        for k in range(a, b):
            by_id[images[k]].set_point3D_for_point2D(keypoints[k], point_id)


def read_model(folder: Path) -> ColmapModel:
    """Cameras and poses of a sparse model.

    Raises:
        FileNotFoundError: there is no model at `folder`.
        ValueError: the model is broken.
    """
    return model_from_reconstruction(read_reconstruction(folder), folder)


def model_from_reconstruction(reconstruction: Any, path: Path) -> ColmapModel:
    """The cameras and poses of a `pycolmap.Reconstruction` that was read from `path`.

    Raises:
        ValueError: a camera or a pose is broken.
    """
    cameras = {}
    for camera_id, c in reconstruction.cameras.items():
        camera = Camera.from_colmap(c)
        if not np.isfinite(camera.params).all() or camera.focal_length <= 0:
            raise ValueError(f"{path}: camera {camera_id} has no valid focal length")
        try:
            camera.check_lens()
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        cameras[int(camera_id)] = camera
    images = sorted(reconstruction.images.values(), key=lambda image: natural_key(image.name))
    posed = [image for image in images if image.has_pose]
    poses = np.array([i.cam_from_world().matrix() for i in posed], np.float64).reshape(-1, 3, 4)
    for image, pose in zip(posed, poses, strict=True):
        if not np.isfinite(pose).all() or abs(np.linalg.det(pose[:, :3]) - 1) > 1e-3:
            raise ValueError(f"{path}: the pose of image {image.name} is not a rigid motion")
    return ColmapModel(
        cameras=cameras,
        names=[image.name for image in posed],
        image_ids=np.array([image.image_id for image in posed], np.int64),
        camera_ids=np.array([image.camera_id for image in posed], np.int32),
        cam_from_world=poses,
        unposed=[image.name for image in images if not image.has_pose],
    )
