"""Makes COLMAP cameras of what OpenCV's programs store."""

from __future__ import annotations

from collections.abc import Sequence

from protomark.geometry.camera import Camera


def opencv_camera(
    size: tuple[int, int],
    focal: Sequence[float],
    center: Sequence[float],
    distortion: Sequence[float] = (),
    fisheye: bool = False,
) -> Camera:
    """The camera of OpenCV's calibration: the centre of the upper left pixel is (0, 0) there.

    Args:
        size: width and height of the images in pixels.
        focal: focal lengths in pixels along x and y.
        center: principal point in pixels.
        distortion: k1, k2, p1, p2 and up to k3, k4, k5, k6; of fisheye cameras k1 to k4.
        fisheye: whether the camera is one of cv::fisheye (Kannala and Brandt).

    Raises:
        ValueError: these are no parameters of a camera.
    """
    params = (*map(float, focal), *(float(c) + 0.5 for c in center))
    bent = tuple(map(float, distortion))
    if fisheye:
        model, count = "OPENCV_FISHEYE", 4
    elif not any(bent):
        model, count = "PINHOLE", 0
    elif not any(bent[4:]):
        model, count = "OPENCV", 4
    else:
        model, count = "FULL_OPENCV", 8
    if any(bent[count:]):
        raise ValueError(f"no COLMAP camera has the {len(bent)} distortion coefficients {bent}")
    bent = (*bent, *[0.0] * count)[:count]
    camera = Camera(model, int(size[0]), int(size[1]), (*params, *bent))
    camera.check()
    return camera
