"""Reads COLMAP models; the only module that imports pycolmap.

Other modules import it from here: `from protomark.geometry.colmap import pycolmap`. pycolmap
contains a zlib of its own, and Python's `zlib` fails in the whole process if it is first imported
after pycolmap, so the order of the two imports below matters.
"""

from __future__ import annotations

import zlib  # noqa: F401  (must come before pycolmap, see above)

# isort: split
import contextlib
import math
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
from protomark.interrupt import raise_if_overdue

# pycolmap takes SIGTERM for itself, to print a stack trace.
_on_sigterm = signal.getsignal(signal.SIGTERM)
pycolmap = optional("pycolmap")
if _on_sigterm is not None and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGTERM, _on_sigterm)

_FILES = ("cameras", "images")
# Steps of the solver in one call.
_SLICE = 10


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
        if _suffix(candidate):
            break
    else:
        raise FileNotFoundError(
            f"{folder} has no COLMAP model (cameras and images, .bin or .txt) in sparse/ or "
            "sparse/0/: name its folder with --model"
        )
    others = [p for p in sorted((folder / "sparse").glob("*")) if p != candidate and _suffix(p)]
    if others:
        names = ", ".join(str(p) for p in others[:5])
        warnings.warn(f"{candidate} is read, other models exist: {names}", stacklevel=2)
    return candidate


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


def bundle_adjust(
    reconstruction: Any,
    image_ids: Iterable[int],
    fixed: Sequence[int] = (),
    *,
    iterations: int = 30,
    loss_scale: float = 1.0,
    intrinsics: bool = False,
    threads: int = 1,
    priors: NDArray[np.float64] | None = None,
    spread: float = 1.0,
) -> bool:
    """Move poses and points to the least (Cauchy) reprojection error; returns whether that worked.

    Args:
        reconstruction: a `pycolmap.Reconstruction`; changed.
        image_ids: images that take part.
        fixed: those of them whose poses stay; with fewer than two, two cameras fix the gauge.
        iterations: limit on the solver's steps.
        loss_scale: pixels beyond which an error counts less.
        intrinsics: whether focal length and distortion move, too.
        threads: threads of the solver; their number changes the last digits.
        priors: (m, 3) camera centres that images 1 to m are likely to have.
        spread: standard deviation of the priors along each axis.
    """
    images, usable = list(image_ids), False
    # Python sees signals only between two calls of the solver.
    for start in range(0, iterations, _SLICE):
        raise_if_overdue()
        limit = min(_SLICE, iterations - start)
        adjuster = _adjuster(
            reconstruction, images, fixed, limit, loss_scale, intrinsics, threads, priors, spread
        )
        with quiet():
            summary = adjuster.solve()
        usable = bool(summary.is_solution_usable())
        if summary.termination_type != pycolmap.BundleAdjustmentTerminationType.NO_CONVERGENCE:
            break
    return usable


def focal_deviations(reconstruction: Any, image_ids: Iterable[int]) -> dict[int, float]:
    """Relative standard deviation of each camera's focal length after bundle adjustment.

    Poses, points and distortion are free, and the residuals say how accurate a keypoint is. The
    value is infinite where the images do not determine the focal length.
    """
    adjuster = _adjuster(reconstruction, image_ids, intrinsics=True)
    options = pycolmap.BACovarianceOptions()
    options.params = pycolmap.BACovarianceOptionsParams.ALL
    with quiet():
        covariance = pycolmap.estimate_ba_covariance(options, reconstruction, adjuster)
    reconstruction.update_point_3d_errors()
    # The mean length of an error with this deviation in x and in y is sqrt(pi / 2) times it.
    noise = reconstruction.compute_mean_reprojection_error() / math.sqrt(math.pi / 2)
    deviations = {}
    for camera_id, camera in reconstruction.cameras.items():
        block = None if covariance is None else covariance.get_other_params_cov(camera.params)
        variance = float(block[0, 0]) if block is not None else math.inf
        valid = math.isfinite(variance) and variance >= 0
        deviation = noise * math.sqrt(variance) / camera.mean_focal_length() if valid else math.inf
        deviations[int(camera_id)] = deviation
    return deviations


def _adjuster(
    reconstruction: Any,
    image_ids: Iterable[int],
    fixed: Sequence[int] = (),
    iterations: int = 30,
    loss_scale: float = 1.0,
    intrinsics: bool = False,
    threads: int = 1,
    priors: NDArray[np.float64] | None = None,
    spread: float = 1.0,
) -> Any:
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = intrinsics
    options.refine_principal_point = False
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_scale
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.max_num_iterations = iterations
    options.ceres.solver_options.function_tolerance = 1e-4
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in image_ids:
        config.add_image(image_id)
    for image_id in fixed:
        config.set_constant_rig_from_world_pose(image_id)
    if len(fixed) < 2:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # Unlike pycolmap.bundle_adjustment, this does not write to the terminal.
    if priors is None:
        return pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
    known = [
        pycolmap.PosePrior(
            corr_data_id=reconstruction.images[i].data_id,
            position=position,
            position_covariance=spread**2 * np.eye(3),
            coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
        )
        for i, position in enumerate(priors, 1)
    ]
    return pycolmap.create_pose_prior_bundle_adjuster(
        options, pycolmap.PosePriorBundleAdjustmentOptions(), config, known, reconstruction
    )


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
