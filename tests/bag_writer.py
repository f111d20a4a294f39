"""Writes images, their camera, and poses to ROS bags."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from protomark.geometry.camera import Camera
from protomark.geometry.pose import quaternion_from_rotation

TOPIC = "/camera/image_raw"
START = 1305031102.25  # seconds
STEP = 0.1


def info_values(camera: Camera, model: str = "plumb_bob") -> dict[str, Any]:
    """What a CameraInfo says of a camera in OpenCV's conventions."""
    fx, fy, cx, cy, *lens = camera.params
    k = np.array([fx, 0, cx - 0.5, 0, fy, cy - 0.5, 0, 0, 1])
    p = np.array([fx, 0, cx - 0.5, 0, 0, fy, cy - 0.5, 0, 0, 0, 1, 0])
    size = {"height": camera.height, "width": camera.width}
    return {"k": k, "d": np.array(lens), "p": p, "distortion_model": model, **size}


def encode(image: NDArray[np.uint8], encoding: str) -> tuple[bytes, int]:
    """The bytes of a grey image in an encoding of ROS, and of a row."""
    height, width = image.shape
    if encoding in ("rgb8", "bgr8", "rgba8", "bgra8"):
        pixels = np.repeat(image[:, :, None], 3 + ("a8" in encoding), 2)
    elif encoding == "mono16":
        pixels = image.astype("<u2") * 16  # 12 bits
    elif encoding in ("yuyv", "uyvy"):
        pixels = np.full((height, width, 2), 128, np.uint8)
        pixels[:, :, int(encoding == "uyvy")] = image
    else:
        pixels = image
    data = pixels.reshape(height, -1)
    padding = np.zeros((height, 6 * data.itemsize), data.dtype)
    data = np.hstack([data, padding])
    return data.tobytes(), data.shape[1] * data.itemsize


def write_bag(
    path: Path,
    images: Iterable[NDArray[np.uint8]],
    info: dict[str, Any] | None = None,
    encoding: str = "mono8",
    topic: str = TOPIC,
    stamps: Iterable[float] | None = None,
    poses: Iterable[tuple[str, float, str, str, NDArray[np.float64]]] = (),
) -> Path:
    """Write images, "compressed" or in an encoding, and return the bag's path.

    `poses` are topic, seconds, parent, child and (3, 4) parent_from_child.
    """
    ros1 = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    tree = "tf2_msgs/msg/TFMessage"
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", tree))
    types = store.types
    kind = "sensor_msgs/msg/" + ("CompressedImage" if encoding == "compressed" else "Image")

    def header(seconds: float, frame: str = "camera") -> Any:
        stamp = types["builtin_interfaces/msg/Time"](int(seconds), round(seconds % 1 * 1e9))
        number = {"seq": 0} if ros1 else {}
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **number)

    def message(image: NDArray[np.uint8], seconds: float) -> Any:
        if encoding == "compressed":
            png = np.frombuffer(cv2.imencode(".png", image)[1].tobytes(), np.uint8)
            return types[kind](header(seconds), "png", png)
        data, step = encode(image, encoding)
        shape = (image.shape[0], image.shape[1], encoding, 0, step)
        return types[kind](header(seconds), *shape, np.frombuffer(data, np.uint8))

    def camera_info() -> Any:
        assert info is not None
        values = {"r": np.eye(3).ravel(), "binning_x": 1, "binning_y": 1, **info}
        roi = types["sensor_msgs/msg/RegionOfInterest"](*values.pop("part", (0, 0, 0, 0)), False)
        if ros1:
            values = {name.upper() if len(name) == 1 else name: v for name, v in values.items()}
        return types["sensor_msgs/msg/CameraInfo"](header=header(START), roi=roi, **values)

    def placed(topic: str, seconds: float, parent: str, child: str, pose: Any) -> tuple[Any, str]:
        w, *xyz = quaternion_from_rotation(pose[:, :3])
        turn, at = types["geometry_msgs/msg/Quaternion"](*xyz, w), pose[:, 3].tolist()
        if topic.startswith("/tf"):
            moved = types["geometry_msgs/msg/Transform"](
                types["geometry_msgs/msg/Vector3"](*at), turn
            )
            one = types["geometry_msgs/msg/TransformStamped"](header(seconds, parent), child, moved)
            return types[tree]([one]), tree
        its = types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](*at), turn)
        if not child:
            kind = "geometry_msgs/msg/PoseStamped"
            return types[kind](header(seconds, parent), its), kind
        zero, noise = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0), np.zeros(36)
        still = types["geometry_msgs/msg/Twist"](zero, zero)
        return types["nav_msgs/msg/Odometry"](
            header(seconds, parent),
            child,
            types["geometry_msgs/msg/PoseWithCovariance"](its, noise),
            types["geometry_msgs/msg/TwistWithCovariance"](still, noise),
        ), "nav_msgs/msg/Odometry"

    serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
    # ROS 2 bags are folders.
    folder = path if ros1 else path.with_suffix("")
    plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
    writer = Writer1(path) if ros1 else Writer2(folder, version=9, storage_plugin=plugin)
    with writer:
        if info is not None:
            name = "sensor_msgs/msg/CameraInfo"
            place = topic.removesuffix("/compressed").rpartition("/")[0] + "/camera_info"
            connection = writer.add_connection(place, name, typestore=store)
            writer.write(connection, int(START * 1e9), serialize(camera_info(), name))
        connection = writer.add_connection(topic, kind, typestore=store)
        times = list(stamps or ())
        for i, image in enumerate(images):
            received = START + STEP * i
            seconds = times[i] if times else received
            data = serialize(message(image, seconds), kind)
            writer.write(connection, int(received * 1e9), data)
        connections: dict[str, Any] = {}
        for topic, seconds, parent, child, pose in poses:
            value, name = placed(topic, seconds, parent, child, pose)
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            writer.write(connections[topic], int(seconds * 1e9), serialize(value, name))
    return path if ros1 else next(folder.glob(f"*{path.suffix}"))
