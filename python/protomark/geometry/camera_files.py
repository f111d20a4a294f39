"""Reads the camera of each image: from a COLMAP model, a cameras.txt, an option, or EXIF data."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from protomark.geometry.camera import CAMERA_EXAMPLE, CAMERA_MODELS, Camera
from protomark.geometry.pose_files import match_names


@dataclass(frozen=True)
class CameraSet:
    """Cameras, and the images that they took."""

    # All cameras; one without a size (0 x 0) fits images of any size.
    cameras: tuple[Camera, ...] = ()
    # Cameras by image name, if the source names images.
    by_image: Mapping[str, Camera] = field(default_factory=dict)

    def for_images(self, names: Iterable[str]) -> CameraSet:
        """The cameras of these images, whose names `match_names` finds."""
        matched = match_names(names, self.by_image)
        return CameraSet(self.cameras, {name: self.by_image[key] for name, key in matched.items()})

    def of_size(self, width: int, height: int) -> list[Camera]:
        """The different cameras that images of this size may come from."""
        sized = {c.sized(width, height) for c in self.cameras}
        return [c for c in sized if (c.width, c.height) == (width, height)]

    def find(self, name: str, width: int, height: int) -> Camera:
        """The camera of an image: by the image's name, else the only one of its size.

        Raises:
            ValueError: no camera fits, or several do.
        """
        if name in self.by_image:
            return self.by_image[name]
        fitting = self.of_size(width, height)
        if len(fitting) == 1:
            return fitting[0]
        if fitting:
            raise ValueError(
                f"{len(fitting)} cameras have {width} x {height} pixels, and none names this "
                "image: give a COLMAP model with images, or one camera"
            )
        sizes = ", ".join(sorted({f"{c.width} x {c.height}" for c in self.cameras}))
        raise ValueError(
            f"the image has {width} x {height} pixels, and no camera does ({sizes}): scale the "
            "image or a camera"
        )


def read_cameras(source: str) -> CameraSet:
    """Read cameras from a cameras.txt, a folder with a COLMAP model, or a camera written out.

    Raises:
        FileNotFoundError, ValueError: the source is none of these, or it is broken.
    """
    if source.partition(":")[0].partition(" ")[0].upper() in CAMERA_MODELS:
        return CameraSet((Camera.parse(source),))
    path = Path(source)
    if not path.exists():
        raise FileNotFoundError(
            f"{source} is no cameras.txt, no folder with a COLMAP model, and no camera such as "
            f"{CAMERA_EXAMPLE}"
        )
    if path.is_file() and path.suffix == ".txt":
        return _read_text(path)
    folder = path if path.is_dir() else path.parent
    has_images = any((folder / f"images.{suffix}").is_file() for suffix in ("txt", "bin"))
    if (folder / "cameras.txt").is_file() and not has_images:
        return _read_text(folder / "cameras.txt")
    return _read_model(folder)


def _read_text(path: Path) -> CameraSet:
    cameras: dict[int, Camera] = {}
    lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    for number, line in enumerate(lines, 1):
        words = line.partition("#")[0].split(maxsplit=1)
        if not words:
            continue
        try:
            camera_id, camera = int(words[0]), Camera.parse(words[1])
        except (ValueError, IndexError, OverflowError) as error:
            raise ValueError(
                f"{path}, line {number}: write a COLMAP camera as id, model, width, height, "
                f"parameters ({error})"
            ) from None
        if camera_id in cameras:
            raise ValueError(f"{path}, line {number}: a second camera {camera_id}")
        cameras[camera_id] = camera
    if not cameras:
        raise ValueError(f"{path} holds no cameras")
    return CameraSet(tuple(cameras.values()))


def _read_model(folder: Path) -> CameraSet:
    from protomark.geometry.colmap import find_model, read_model

    model = read_model(find_model(folder))
    by_image = {
        name: model.cameras[int(i)] for name, i in zip(model.names, model.camera_ids, strict=True)
    }
    return CameraSet(tuple(model.cameras.values()), by_image)


def camera_from_exif(image: Path) -> Camera | None:
    """A camera with the focal length of the image's EXIF data, None if they lack one."""
    from protomark.geometry.colmap import pycolmap, quiet

    options = pycolmap.ImageReaderOptions()
    options.camera_model = "SIMPLE_PINHOLE"
    with quiet():
        try:
            camera = pycolmap.infer_camera_from_image(str(image), options)
        except (ValueError, RuntimeError):
            return None
    if not camera.has_prior_focal_length:
        return None
    return Camera.from_colmap(camera)
