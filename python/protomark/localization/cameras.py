"""The camera of each image, from a file, an option, or the image itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from protomark.localization.absolute_pose import MODELS, check_camera
from protomark.tracks.file import Camera

_EXAMPLE = "PINHOLE:525,525,320,240 or 'PINHOLE 640 480 525 525 320 240'"


@dataclass(frozen=True)
class Cameras:
    """Cameras, and which image was taken by which.

    Attributes:
        cameras: all of them; one without a size (0 x 0) serves images of any.
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
        given = {replace(c, width=width, height=height) if not c.width else c for c in self.cameras}
        fitting = [c for c in given if (c.width, c.height) == (width, height)]
        if len(fitting) == 1:
            return fitting[0]
        sizes = ", ".join(sorted({f"{c.width} x {c.height}" for c in given}))
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
    """A camera written out: MODEL:PARAMETERS, or as in a line of cameras.txt with its size.

    Raises:
        ValueError: it is none.
    """
    sized = ":" not in text
    words = text.replace(":", " ").replace(",", " ").split()
    try:
        size = (int(words[1]), int(words[2])) if sized else (0, 0)
        params = tuple(map(float, words[3 if sized else 1 :]))
    except IndexError:
        raise ValueError(f"camera {text!r} lacks numbers, for example {_EXAMPLE}") from None
    except ValueError:
        raise ValueError(
            f"camera {text!r} has a number that is none, for example {_EXAMPLE}"
        ) from None
    if sized and min(size) < 1:
        raise ValueError(f"camera {text!r} has no pixels, for example {_EXAMPLE}")
    camera = Camera(words[0].upper(), *size, params)
    check_camera(camera)
    return camera


def read_cameras(source: str) -> Cameras:
    """Cameras from a cameras.txt, a folder with a COLMAP model, or a camera written out.

    Raises:
        FileNotFoundError, ValueError: it is none of these, or broken.
    """
    if source.partition(":")[0].partition(" ")[0].upper() in MODELS:
        return Cameras((parse_camera(source),))
    path = Path(source)
    if not path.exists():
        raise FileNotFoundError(
            f"{source}: no cameras.txt, no folder with a COLMAP model, and no camera such as "
            f"{_EXAMPLE}"
        )
    if path.is_dir() and not ((path / "cameras.txt").is_file() and not _has_images(path)):
        return _of_model(path)
    from protomark.tracks.colmap import read_cameras as cameras_of

    found = tuple(cameras_of(path).values())
    if not found:
        raise ValueError(f"{path}: no cameras in it")
    for camera in found:
        check_camera(camera)
    return Cameras(found)


def _has_images(folder: Path) -> bool:
    return any((folder / f"images.{ending}").is_file() for ending in ("txt", "bin"))


def _of_model(folder: Path) -> Cameras:
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
