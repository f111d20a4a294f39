"""The camera of each image, from a file, an option, or the image itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from protomark.localization.absolute_pose import MODELS, check_camera
from protomark.tracks.file import Camera


@dataclass(frozen=True)
class Cameras:
    """Cameras, and which image was taken by which.

    Attributes:
        cameras: all of them.
        of_image: by image name, where that is known.
    """

    cameras: tuple[Camera, ...] = ()
    of_image: Mapping[str, Camera] = field(default_factory=dict)

    def find(self, name: str, width: int, height: int) -> Camera:
        """The camera of an image: by its name, else the only one of its size.

        Raises:
            ValueError: there is none, or there are several.
        """
        for key in (name, Path(name).name):
            if key in self.of_image:
                return self.of_image[key]
        fitting = [c for c in self.cameras if (c.width, c.height) == (width, height)]
        if len(fitting) == 1:
            return fitting[0]
        sizes = ", ".join(sorted({f"{c.width} x {c.height}" for c in self.cameras}))
        if fitting:
            raise ValueError(
                f"{len(fitting)} of the cameras have {width} x {height} pixels and none names this "
                "image: give a model folder with images, or one camera"
            )
        raise ValueError(
            f"the image has {width} x {height} pixels, and none of the cameras does ({sizes}): "
            "scale one of them"
        )


def parse_camera(text: str) -> Camera:
    """A camera as a line of cameras.txt says it, with or without its id.

    Raises:
        ValueError: it is none.
    """
    words = text.replace(",", " ").split()
    if words and words[0].isdigit():
        words = words[1:]
    example = "for example PINHOLE 640 480 525 525 320 240"
    if len(words) < 4:
        raise ValueError(f"camera {text!r} is not MODEL WIDTH HEIGHT PARAMETERS, {example}")
    try:
        camera = Camera(words[0], int(words[1]), int(words[2]), tuple(map(float, words[3:])))
    except ValueError:
        raise ValueError(f"camera {text!r} has a number that is none, {example}") from None
    if camera.width < 1 or camera.height < 1:
        raise ValueError(f"camera {text!r} has no pixels, {example}")
    check_camera(camera)
    return camera


def read_cameras(source: str) -> Cameras:
    """Cameras from a cameras.txt, a folder with a COLMAP model, or a camera written out.

    Raises:
        FileNotFoundError, ValueError: it is none of these, or broken.
    """
    path = Path(source)
    if path.is_dir():
        return _of_model(path)
    if path.is_file():
        lines = [line.strip() for line in path.read_text(errors="replace").splitlines()]
        try:
            found = tuple(parse_camera(x) for x in lines if x and not x.startswith("#"))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        if not found:
            raise ValueError(f"{path}: no camera in it")
        return Cameras(found)
    if source.split(" ")[0] not in MODELS:
        raise FileNotFoundError(
            f"{source}: no cameras.txt, no folder with a COLMAP model, and no camera such as "
            "'PINHOLE 640 480 525 525 320 240'"
        )
    return Cameras((parse_camera(source),))


def _of_model(folder: Path) -> Cameras:
    text = folder / "cameras.txt"
    if text.is_file() and not (folder / "images.txt").is_file():
        return read_cameras(str(text))
    from protomark.tracks.colmap import find_model, model_of, read_reconstruction

    path = find_model(folder)
    model = model_of(read_reconstruction(path), path)
    for camera in model.cameras.values():
        check_camera(camera)
    named = {
        name: model.cameras[int(i)] for name, i in zip(model.names, model.camera_ids, strict=True)
    }
    return Cameras(tuple(model.cameras.values()), named)


def camera_of_exif(image: Path) -> Camera | None:
    """What the image's EXIF data say of its focal length; None where they say nothing."""
    from protomark.tracks.colmap import pycolmap, quiet

    options = pycolmap.ImageReaderOptions()
    options.camera_model = "SIMPLE_PINHOLE"
    with quiet():
        try:
            camera = pycolmap.infer_camera_from_image(str(image), options)
        except (ValueError, RuntimeError):
            return None
    if not camera.has_prior_focal_length:
        return None
    params = tuple(float(p) for p in camera.params)
    return Camera(camera.model.name, camera.width, camera.height, params)
