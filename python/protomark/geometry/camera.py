"""Cameras with COLMAP's models; only projection needs pycolmap."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Number of parameters of COLMAP's camera models (src/colmap/sensor/models.h there).
CAMERA_MODELS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
    "SIMPLE_DIVISION": 4,
    "DIVISION": 5,
    "SIMPLE_FISHEYE": 3,
    "FISHEYE": 4,
    "EUCM": 6,
    "EQUIRECTANGULAR": 2,
}
# COLMAP's guess of an unknown focal length, as a share of the image's longer side.
DEFAULT_FOCAL_RATIO = 1.2
_WIDE_MODELS = ("FISHEYE", "FOV", "EUCM", "DIVISION", "EQUIRECTANGULAR")
_MAX_ROUND_TRIP = 0.5  # pixels
# Farther than 60 degrees from the axis (tangent), small angles are long ways in the image plane.
MAX_PLANE_RAY = 1.7
_MIN_VIEW, _MAX_VIEW = 1.0, 170.0  # degrees
# Lenses do not bend rays to less than this share of their distance from the axis.
_MIN_BENDING = 0.5
# Calibrations put the principal point at most this share of the image from its middle.
_MAX_OFFSET = 0.2
CAMERA_EXAMPLE = "PINHOLE:525,525,320,240 or 'PINHOLE 640 480 525 525 320 240'"


@dataclass(frozen=True)
class Camera:
    """A COLMAP camera.

    Attributes:
        model: name of the camera model, such as "PINHOLE".
        width: image width in pixels; 0 if the camera fits images of any size.
        height: image height in pixels; 0 likewise.
        params: the model's parameters in COLMAP's order. The centre of the upper left pixel is at
            (0.5, 0.5).
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @classmethod
    def parse(cls, text: str) -> Camera:
        """Read MODEL:PARAMETERS, or MODEL WIDTH HEIGHT PARAMETERS as in COLMAP's cameras.txt.

        Raises:
            ValueError: the text is no such camera.
        """
        has_size = ":" not in text
        words = text.replace(":", " ").replace(",", " ").split()
        try:
            size = (_pixels(words[1]), _pixels(words[2])) if has_size else (0, 0)
            params = tuple(map(float, words[3 if has_size else 1 :]))
            name = words[0].upper()
        except IndexError:
            raise ValueError(
                f"camera {text!r} lacks numbers: write, for example, {CAMERA_EXAMPLE}"
            ) from None
        except ValueError:
            raise ValueError(
                f"camera {text!r} has a parameter that is not a number: write, for example, "
                f"{CAMERA_EXAMPLE}"
            ) from None
        if has_size and min(size) < 1:
            raise ValueError(f"camera {text!r} has no pixels: write, for example, {CAMERA_EXAMPLE}")
        camera = cls(name, *size, params)
        camera.check_params()
        if has_size:
            camera.check_lens()
        return camera

    @classmethod
    def guess(cls, width: int, height: int) -> Camera:
        """A pinhole camera for an image of this size, with the focal length that COLMAP guesses."""
        focal = DEFAULT_FOCAL_RATIO * max(width, height)
        return cls("SIMPLE_PINHOLE", width, height, (focal, width / 2, height / 2))

    @classmethod
    def from_colmap(cls, camera: Any) -> Camera:
        """The camera of a `pycolmap.Camera`.

        Raises:
            TypeError: it is something else.
        """
        try:
            params = tuple(float(p) for p in camera.params)
            return cls(camera.model.name, camera.width, camera.height, params)
        except AttributeError:
            raise TypeError(
                f"a camera is a pm.Camera, a pycolmap.Camera or a str, not {type(camera).__name__}"
            ) from None

    @classmethod
    def from_opencv(
        cls,
        width: int,
        height: int,
        pinhole: Sequence[float],
        distortion: Sequence[float] = (),
        fisheye: bool = False,
    ) -> Camera:
        """A camera in OpenCV's conventions: (0, 0) is the centre of the first pixel.

        Args:
            width: image width in pixels.
            height: image height in pixels.
            pinhole: fx, fy, cx, cy.
            distortion: k1, k2, p1, p2, k3, k4, k5, k6 or the first of these; of a fisheye lens k1
                to k4.
            fisheye: whether it is a fisheye lens.

        Raises:
            ValueError: the numbers make no camera.
        """
        fx, fy, cx, cy = map(float, pinhole)
        lens = [float(k) for k in distortion]
        size = 4 if fisheye else 8
        if any(lens[size:]):
            raise ValueError(f"{len(lens)} distortion coefficients are more than COLMAP's {size}")
        lens = [*lens, *[0.0] * size][:size]
        model = "OPENCV_FISHEYE"
        if not fisheye:
            model = "FULL_OPENCV" if any(lens[4:]) else "OPENCV" if any(lens) else "PINHOLE"
        params = (fx, fy, cx + 0.5, cy + 0.5, *lens)
        camera = cls(model, width, height, params[: CAMERA_MODELS[model]])
        camera.check()
        if fy <= 0:
            raise ValueError(f"a camera of model {model} has a focal length that is not positive")
        return camera

    def as_dict(self) -> dict[str, Any]:
        """The camera as JSON values, in the form that PoseLib and pycolmap take."""
        return {
            "model": self.model,
            "width": self.width,
            "height": self.height,
            "params": list(self.params),
        }

    def __str__(self) -> str:
        """The line of COLMAP's cameras.txt without the id."""
        params = " ".join(f"{p:.12g}" for p in self.params)
        return f"{self.model} {self.width} {self.height} {params}"

    def check(self) -> None:
        """Raise ValueError unless model, size and parameters make a COLMAP camera."""
        for size in (self.width, self.height):
            if type(size) is not int or not 0 < size < 2**31:
                raise ValueError(f"{str(size)[:40]!r} is not a number of pixels")
        self.check_params()

    def check_params(self) -> None:
        """Raise ValueError unless model, number of parameters and focal length are COLMAP's."""
        expected = CAMERA_MODELS.get(self.model) if isinstance(self.model, str) else None
        if expected is None:
            raise ValueError(
                f"COLMAP has no camera model {str(self.model)[:40]!r}; its models are "
                f"{', '.join(CAMERA_MODELS)}"
            )
        if len(self.params) != expected:
            raise ValueError(
                f"a camera of model {self.model} has {expected} parameters, not {len(self.params)}"
            )
        if not all(isinstance(p, Real) and math.isfinite(p) for p in self.params):
            raise ValueError(f"the parameters {self.params} are not all finite numbers")
        if self.params[0] <= 0:
            raise ValueError(
                f"a camera of model {self.model} has a focal length that is not positive"
            )

    def sized(self, width: int, height: int) -> Camera:
        """The camera for images of this size, if it fits any size; else itself.

        Raises:
            ValueError: see `check_lens`.
        """
        camera = self if self.width else replace(self, width=width, height=height)
        camera.check_lens()
        return camera

    def resized(self, width: int, height: int) -> Camera:
        """The camera of the same images at another size."""
        if (width, height) == (self.width, self.height):
            return self
        from protomark.geometry.colmap import pycolmap

        camera = pycolmap.Camera(self.as_dict())
        camera.rescale(width, height)
        return Camera.from_colmap(camera)

    def zoomed(self, factor: float) -> Camera:
        """The camera with a focal length that is `factor` times as long."""
        params = np.array(self.params)
        params[self.colmap.focal_length_idxs()] *= factor
        return replace(self, params=tuple(params.tolist()))

    def resembles(self, other: Camera) -> bool:
        """Whether both project alike: same size, and rays within 1 % of the image."""
        if (self.width, self.height) != (other.width, other.height):
            return False
        share = np.linspace(0, 1, 5)
        grid = np.stack(np.meshgrid(share * self.width, share * self.height), -1).reshape(-1, 2)
        difference = np.abs(self.bearings(grid) - other.bearings(grid)) * other.focal_length
        return bool(np.nanmax(difference, initial=0.0) <= 0.01 * max(self.width, self.height))

    def check_lens(self) -> None:
        """Warn if the camera is unlikely to be the image's, for example of another resolution.

        Raises:
            ValueError: no lens is like that: its principal point lies outside the image, its field
                of view is below 1 or above 170 degrees (wide-angle models may see more), or its
                distortion cannot be undone all over the image.
        """
        if doubt := self.lens_doubt():
            warnings.warn(doubt, stacklevel=1)  # of one place, so that it is shown once per camera

    def lens_doubt(self) -> str:
        """A sentence if the camera is unlikely to be the image's, else ""; see `check_lens`."""
        return _check_lens(self)

    @property
    def colmap(self) -> Any:
        """The camera as a `pycolmap.Camera`.

        Raises:
            ValueError: the installed pycolmap lacks the model, or rejects the parameters.
        """
        return _colmap_camera(self)

    @property
    def focal_length(self) -> float:
        """Mean focal length in pixels; of spherical images, pixels per radian."""
        return float(self.colmap.mean_focal_length()) or self.width / (2 * math.pi)

    @property
    def wide(self) -> bool:
        """Whether the model is one for wide angles, which may reach behind the camera."""
        return any(word in self.model for word in _WIDE_MODELS)

    def rays(self, pixels: NDArray[Any]) -> NDArray[np.float64]:
        """Undistort pixels (n, 2) to x / z and y / z (n, 2) float64, NaN where the model fails.

        Rays of wide cameras are NaN where they do not lead forward.
        """
        out = np.full((len(pixels), 2), np.nan)
        if self.wide:
            bearings = self.bearings(pixels)
            front = bearings[:, 2] > 0
            out[front] = bearings[front, :2] / bearings[front, 2:]
        elif len(pixels):
            out[:] = np.asarray(self.colmap.cam_from_img(np.asarray(pixels, np.float64)))
        return out

    def bearings(self, pixels: NDArray[Any]) -> NDArray[np.float64]:
        """Unit vectors (n, 3) float64 toward what pixels (n, 2) show, NaN where the model fails."""
        out = np.full((len(pixels), 3), np.nan)
        if len(pixels):
            pixels = np.asarray(pixels, np.float64)
            out[:] = np.asarray(self.colmap.cam_ray_from_img(pixels))
            # Beyond their reach, COLMAP's models unproject to rays of other pixels.
            off = np.abs(self.project(out) - pixels).max(axis=1)
            out[~(off < _MAX_ROUND_TRIP)] = np.nan
        return out

    def local_rays(
        self, pixels: NDArray[Any]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Rays (n, 2) as by `rays`, and how the camera is turned (n, 3, 3) for each; None: not.

        A wide camera is turned so that it looks along the ray, which is (0, 0) then: errors that
        pinhole cameras have in the image plane are angles in any direction.
        """
        if not self.wide:
            return self.rays(pixels), None
        bearings = self.bearings(pixels)
        found = np.isfinite(bearings)
        x, y, z = np.where(found, bearings, [0.0, 0.0, 1.0]).T
        near = np.maximum(1 + z, 1e-12)
        turns = np.array(
            [
                [1 - x * x / near, -x * y / near, -x],
                [-x * y / near, 1 - y * y / near, -y],
                [x, y, z],
            ]
        )
        return np.where(found[:, :2], 0.0, np.nan), turns.transpose(2, 0, 1)

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project points (n, 3) in camera coordinates to pixels (n, 2), infinite behind it."""
        out = np.full((len(points), 2), np.inf)
        spherical = self.model == "EQUIRECTANGULAR"
        front = np.isfinite(points).all(axis=1) if spherical else points[:, 2] > 0
        if front.any():
            out[front] = np.asarray(self.colmap.img_from_cam(np.asarray(points[front], np.float64)))
        return out


def _pixels(word: str) -> int:
    number = float(word)
    if not number.is_integer():
        raise ValueError
    return int(number)


@lru_cache(maxsize=256)
def _check_lens(camera: Camera) -> str:
    size = np.array([camera.width, camera.height])
    middle = np.array(camera.colmap.params)[camera.colmap.principal_point_idxs()]
    if camera.model == "EQUIRECTANGULAR":
        if camera.params != (camera.width, camera.height):
            raise ValueError(f"camera {camera}: its parameters are not the size of the image")
        return ""
    if not ((middle > 0) & (middle < size)).all():
        raise ValueError(
            f"camera {camera}: its principal point lies outside the image: was it calibrated at "
            "another resolution?"
        )
    if camera.wide:
        view = math.degrees(size.max() / camera.focal_length)
    else:
        view = _perspective_view(camera, middle)
    if not view >= _MIN_VIEW:
        raise ValueError(f"camera {camera}: its field of view is {view:.2g} degrees, below 1")
    if (abs(middle - size / 2) > _MAX_OFFSET * size).any():
        at = "{:.0f} x {:.0f}".format(*(2 * middle))
        return (
            f"camera {camera}: its principal point is far from the middle of the image: was it "
            f"calibrated at {at} pixels?"
        )
    return ""


def _perspective_view(camera: Camera, middle: NDArray[np.float64]) -> float:
    """Field of view along the longer side, degrees; raises ValueError if distortion is absurd."""
    share = np.linspace(0, 1, 9)
    grid = np.stack(np.meshgrid(share * camera.width, share * camera.height), -1).reshape(-1, 2)
    rays, straight = camera.rays(grid), (grid - middle) / camera.focal_length
    reach = np.linalg.norm(straight, axis=1)
    bending = np.linalg.norm(rays, axis=1)[reach > 0] / reach[reach > 0]
    if not (bending > _MIN_BENDING).mean() > 0.9:  # false for NaN
        raise ValueError(f"camera {camera}: no lens distorts like that, check its coefficients")
    angles = np.degrees(np.arctan(rays))
    view = float(np.nanmax(np.nanmax(angles, axis=0) - np.nanmin(angles, axis=0)))
    if view > _MAX_VIEW:
        raise ValueError(
            f"camera {camera}: its field of view is {view:.1f} degrees, above {_MAX_VIEW:g}, as "
            "only wide-angle models have it (OPENCV_FISHEYE)"
        )
    return view


@lru_cache(maxsize=256)
def _colmap_camera(camera: Camera) -> Any:
    from protomark.geometry.colmap import pycolmap

    # pycolmap reads past the end of too few parameters.
    camera.check_params()
    try:
        converted = pycolmap.Camera(camera.as_dict())
    except (RuntimeError, ValueError):
        raise ValueError(
            f"this pycolmap does not know camera model {camera.model}: update pycolmap"
        ) from None
    if not converted.verify_params():
        raise ValueError(f"{camera.params} are not parameters of camera model {camera.model}")
    return converted


def cameras_from_json(value: Any) -> dict[int, Camera]:
    """Cameras by id, from a JSON object with the values of `Camera.as_dict`.

    Raises:
        ValueError: the value is no such object, or a camera is not COLMAP's.
    """
    if not isinstance(value, dict):
        raise ValueError("cameras are not a JSON object")
    cameras = {}
    for number, c in value.items():
        try:
            params = c["params"]
            if not isinstance(params, list) or any(type(p) not in (int, float) for p in params):
                raise ValueError("params are not a list of numbers")
            camera = Camera(c["model"], c["width"], c["height"], tuple(map(float, params)))
            camera.check()
            cameras[int(number)] = camera
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"cameras: {number[:20]!r}: {error}") from None
    return cameras
