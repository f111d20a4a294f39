"""Reads a camera's images from a ROS bag: `.bag`, `.mcap`, `.db3`, or the folder of a ROS 2 bag."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.extras import optional
from protomark.features.images import to_8_bits
from protomark.features.video import Decode
from protomark.geometry.camera import Camera

_SUFFIXES = (".bag", ".mcap", ".db3")
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_INFO = "sensor_msgs/msg/CameraInfo"
# Encodings (sensor_msgs/image_encodings.h) -> channels, and OpenCV's conversion to grey, if any.
_GRAY = ("mono8", "8UC1", "mono16", "16UC1")
_COLORS = {
    **{"rgb8": (3, "RGB"), "bgr8": (3, "BGR"), "8UC3": (3, "BGR")},
    **{"rgba8": (4, "RGBA"), "bgra8": (4, "BGRA"), "8UC4": (4, "BGRA")},
}
# ROS names the first two pixels of the first row, OpenCV those of the second.
_BAYER = {
    **{"bayer_rggb8": "BayerBG", "bayer_bggr8": "BayerRG"},
    **{"bayer_gbrg8": "BayerGR", "bayer_grbg8": "BayerGB"},
}
# Where the brightness is among the bytes of two pixels.
_YUV = {"yuv422": 1, "uyvy": 1, "yuv422_yuy2": 0, "yuyv": 0}


def is_bag(path: Path) -> bool:
    """Whether a path is named like a bag, or is the folder of one."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.suffix.lower() in _SUFFIXES


def image_topic(path: Path, topic: str | None = None) -> tuple[str, int]:
    """The topic of a bag's images, and their number.

    Args:
        path: the bag.
        topic: the topic; None: the only one with images.

    Raises:
        ValueError: there is no such topic, or it is not the only one; or the bag is broken.
    """
    with opened(path) as bag:
        found = {
            name: info.msgcount for name, info in bag.topics.items() if info.msgtype in _IMAGES
        }
    listed = ", ".join(sorted(found)) or "none (has the file been cut off? try `mcap recover`)"
    if topic is None:
        if len(found) != 1:
            raise ValueError(f"{path}: topics with images are {listed}: choose one with --topic")
        (topic,) = found
    elif topic not in found:
        raise ValueError(f"{path}: no images on --topic {topic}; topics with images are {listed}")
    if not found[topic]:
        raise ValueError(f"{path}: no image was recorded on {topic}")
    return topic, found[topic]


def bag_frames(path: Path, topic: str, every: int = 1) -> Iterator[tuple[str, float, Decode]]:
    """Name and time in seconds of every n-th image, and what decodes it.

    Times are those of the images' headers, and ascend.

    Raises:
        ValueError: the bag is broken.
    """
    time = -np.inf
    with opened(path) as bag:
        connections = [c for c in bag.connections if c.topic == topic]
        for number, (connection, received, data) in enumerate(bag.messages(connections)):
            if number % every:
                continue
            message = bag.deserialize(data, connection.msgtype)
            # A clock may be set back.
            time = max(seconds(message.header.stamp, received), np.nextafter(time, np.inf))
            yield f"{path.stem}-{number:06d}", time, lambda m=message: _decode(path, m)  # type: ignore[misc]


def bag_camera(path: Path, topic: str) -> Camera | None:
    """The calibrated camera of a bag's images, None if it says nothing of it.

    This is the first CameraInfo on the topic `camera_info` beside that of the images. Images whose
    topic is named so are rectified.

    Raises:
        ValueError: it is of a model that COLMAP does not have; or the bag is broken.
    """
    base, _, name = topic.removesuffix("/compressed").rpartition("/")
    with opened(path) as bag:
        connections = [
            c for c in bag.connections if c.topic == f"{base}/camera_info" and c.msgtype == _INFO
        ]
        for connection, _, data in bag.messages(connections) if connections else ():
            info = bag.deserialize(data, connection.msgtype)
            try:
                return _camera(info, "rect" in name)
            except ValueError as error:
                raise ValueError(
                    f"{path}: the camera on {base}/camera_info: {error}: give it with --camera"
                ) from None
    return None


def camera_of_size(path: Path, camera: Camera, width: int, height: int) -> Camera:
    """A bag's camera at the size of its images.

    Raises:
        ValueError: the images have other proportions.
    """
    if abs(width * camera.height - height * camera.width) > max(width, height):
        raise ValueError(
            f"{path}: images of {width} x {height} pixels, but the bag's camera has "
            f"{camera.width} x {camera.height}: give that of the images with --camera"
        )
    return camera.resized(width, height)


def seconds(stamp: Any, received: int) -> float:
    """The time of a message's header; some drivers leave it out: that of its receipt, then."""
    return float(stamp.sec) + float(stamp.nanosec) / 1e9 or received / 1e9


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open a bag; whatever fails in it, here or in the block, is a ValueError."""
    highlevel, typesys = optional("rosbags.highlevel"), optional("rosbags.typesys")
    # ROS 2 bags in SQLite do not say what their messages hold.
    types = typesys.get_typestore(typesys.Stores.LATEST)
    try:
        with highlevel.AnyReader([path], default_typestore=types) as bag:
            yield bag
    except FileNotFoundError:
        raise
    except Exception as error:
        if str(error).startswith(f"{path}: "):
            raise
        reason = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise ValueError(f"{path}: not a ROS bag, or a broken one ({reason})") from None


def _camera(info: Any, rectified: bool) -> Camera | None:
    # ROS 1 has K, D and P where ROS 2 has k, d and p.
    k, d, p = (getattr(info, name, getattr(info, name.lower(), None)) for name in "KDP")
    shape = (3, 4) if rectified else (3, 3)
    matrix = np.asarray(p if rectified else k, np.float64).reshape(shape)
    fx, fy, cx, cy = (float(matrix[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if fx == 0:
        return None  # not calibrated
    lens = [] if rectified else np.asarray(d, np.float64).tolist()
    model = str(info.distortion_model)
    fisheye = model in ("equidistant", "fisheye", "kannala_brandt4")
    if any(lens) and not fisheye and model not in ("plumb_bob", "rational_polynomial"):
        raise ValueError(f"distortion model {model[:40]!r}")
    # The matrix is that of the whole sensor, of which images may be a part, at lower resolution.
    part, bins = info.roi, (max(info.binning_x, 1), max(info.binning_y, 1))
    width, height = (
        (inside or whole) // n
        for inside, whole, n in zip(
            (part.width, part.height), (info.width, info.height), bins, strict=True
        )
    )
    cx, cy = (
        (c + 0.5 - begin) / n - 0.5
        for c, begin, n in zip((cx, cy), (part.x_offset, part.y_offset), bins, strict=True)
    )
    pinhole = (fx / bins[0], fy / bins[1], cx, cy)
    return Camera.from_opencv(int(width), int(height), pinhole, lens, fisheye and not rectified)


def _decode(path: Path, message: Any) -> NDArray[np.uint8] | None:
    """An image message as (height, width) uint8; None if it does not decode."""
    cv2 = optional("cv2")
    data = np.frombuffer(memoryview(message.data), np.uint8)
    if not hasattr(message, "encoding"):
        try:
            image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        except cv2.error:
            return None
        return None if image is None else np.asarray(image, np.uint8)
    encoding, height, width, step = message.encoding, message.height, message.width, message.step
    if height * step > len(data) or not height or not width:
        return None
    rows = data[: height * step].reshape(height, step)
    depth = 2 if "16" in encoding else 1
    channels, color = _COLORS.get(encoding, (2 if encoding in _YUV else 1, ""))
    if step < depth * channels * width:
        return None
    rows = np.ascontiguousarray(rows[:, : depth * channels * width])
    if encoding in _GRAY:
        return (
            rows if depth == 1 else to_8_bits(rows.view(">u2" if message.is_bigendian else "<u2"))
        )
    if color:
        pixels = rows.reshape(height, width, channels)
        return np.asarray(cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{color}2GRAY")), np.uint8)
    if encoding in _BAYER:
        code = getattr(cv2, f"COLOR_{_BAYER[encoding]}2GRAY")
        return np.asarray(cv2.cvtColor(rows, code), np.uint8)
    if encoding in _YUV:
        return np.ascontiguousarray(rows[:, _YUV[encoding] :: 2])
    raise ValueError(
        f"{path}: images of encoding {encoding[:40]!r} are not read: record the topic of an image "
        "processor (mono8 or rgb8), or the compressed one"
    )
