"""Poses in ROS bags: reads those of a camera from /tf, odometry or poses, and writes others."""

from __future__ import annotations

import tempfile
import warnings
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.extras import optional
from protomark.features.bag import opened, seconds
from protomark.files import replacing
from protomark.geometry.pose import (
    camera_centers,
    inverse,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from protomark.geometry.pose_files import PoseSet

Array = NDArray[np.float64]

_TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_STAMPED = (
    "nav_msgs/msg/Odometry",
    *(f"geometry_msgs/msg/{n}Stamped" for n in ("Pose", "PoseWithCovariance", "Transform")),
)
# Names of what is written, which must not be another link of the robot's own tree.
POSE_TOPIC, WORLD, CAMERA = "/localized/pose", "map", "localized_camera"


def bag_poses(
    path: Path, topic: str, images: str, frames: Sequence[tuple[str, float]]
) -> PoseSet | None:
    """The poses of a bag's images by a topic of poses; None if `topic` is a file, and no topic.

    On a topic of transforms (/tf, with /tf_static) the world is the root of the tree that the
    camera's frame, that of the images' headers, is in. An Odometry or TransformStamped moves its
    child frame, on which transforms say how the camera is mounted; other poses are the camera's
    own. Between two messages a frame moves evenly; outside of them images have no pose.

    Args:
        path: the bag.
        topic: the topic of poses, or a file.
        images: the topic of the images.
        frames: names and times of the images.

    Raises:
        ValueError: there is no such topic, nothing says where the camera is, or the bag is broken.
    """
    with opened(path) as bag:
        kinds = {n: info.msgtype for n, info in bag.topics.items()}
        if topic not in kinds and Path(topic).exists():
            return None
        if kinds.get(topic) not in (*_TF, *_STAMPED):
            known = ", ".join(sorted(n for n in kinds if kinds[n] in (*_TF, *_STAMPED))) or "none"
            raise ValueError(f"{path}: no poses on {topic}; topics with poses are {known}")
        messages = bag.messages([c for c in bag.connections if c.topic == images])
        connection, _, first = next(messages, (None, 0, b""))
        if connection is None:
            raise ValueError(f"{path}: none of its images can be read")
        camera = _name(bag.deserialize(first, connection.msgtype).header.frame_id)
        tree = topic if kinds[topic] in _TF else "/tf"
        links = _read_links(path, bag, [tree, f"{tree}_static"])
        given = _read_links(path, bag, [topic], camera) if tree != topic else {}
        links |= given
        for link in given.values():
            links.pop(link.parent, None)  # the world is the one that was asked for
        poses = _poses_in_world(path, links, camera, np.array([t for _, t in frames]))
        if unlinked := set(given) - set(_way(path, links, camera)):
            raise ValueError(
                f"{path}: {topic} has the poses of {unlinked.pop()!r}, and no transform on /tf or "
                f"/tf_static leads from there to the images' frame {camera!r}"
            )
    found = {
        name: inverse(pose)
        for (name, _), pose in zip(frames, poses, strict=True)
        if np.isfinite(pose).all()
    }
    told = f"{path}: of {len(frames)} images {len(found)} were taken while {topic} had poses"
    if not found:
        raise ValueError(told)
    if 2 * len(found) < len(frames):
        warnings.warn(told, stacklevel=2)
    return PoseSet(found)


def _name(frame: str) -> str:
    return str(frame).strip("/")


@dataclass
class _Link:
    """How a frame lies in its parent, by time."""

    parent: str
    static: bool  # whether the last motion is that of all times
    times: array[float] = field(default_factory=lambda: array("d"))
    # x, y, z and quaternion w, x, y, z of each time.
    motions: array[float] = field(default_factory=lambda: array("d"))

    def at(self, times: Array) -> Array:
        """Poses parent_from_frame (n, 3, 4) at times (n,), NaN outside of those that are known."""
        motions = np.array(self.motions).reshape(-1, 7)
        if self.static:
            one = np.column_stack([rotation_from_quaternion(motions[-1, 3:]), motions[-1, :3]])
            return np.tile(one, (len(times), 1, 1))
        known, rows = np.unique(self.times, return_index=True)
        motions = motions[rows]
        after = np.clip(np.searchsorted(known, times), 1, max(len(known) - 1, 1)) % len(known)
        a, b = motions[after - 1], motions[after]
        step = known[after] - known[after - 1]
        share = ((times - known[after - 1]) / np.where(step == 0, 1, step))[:, None]
        quaternion = _slerp(a[:, 3:], b[:, 3:], share)
        at = a[:, :3] + share * (b[:, :3] - a[:, :3])
        poses = np.concatenate([rotation_from_quaternion(quaternion), at[:, :, None]], axis=2)
        poses[(times < known[0]) | (times > known[-1])] = np.nan
        return poses


def _slerp(a: Array, b: Array, share: Array) -> Array:
    """Quaternions (n, 4) that divide the turns between others (Shoemake, SIGGRAPH 1985)."""
    cosine = (a * b).sum(axis=1, keepdims=True)
    b = np.where(cosine < 0, -b, b)
    angle = np.arccos(np.clip(np.abs(cosine), 0, 1))
    sine = np.sin(angle)
    even = sine < 1e-6
    sine = np.where(even, 1, sine)
    first, second = np.sin((1 - share) * angle) / sine, np.sin(share * angle) / sine
    return np.where(even, 1 - share, first) * a + np.where(even, share, second) * b


def _read_links(path: Path, bag: Any, topics: Sequence[str], camera: str = "") -> dict[str, _Link]:
    """The links of frames to their parents; a pose that names no frame is the camera's."""
    links: dict[str, _Link] = {}
    connections = [c for c in bag.connections if c.topic in topics]
    for connection, received, data in bag.messages(connections) if connections else ():
        message = bag.deserialize(data, connection.msgtype)
        for one in getattr(message, "transforms", [message]):
            frame = _name(getattr(one, "child_frame_id", "")) or camera
            parent = _name(one.header.frame_id)
            link = links.setdefault(frame, _Link(parent, connection.topic.endswith("_static")))
            if link.parent != parent:
                raise ValueError(
                    f"{path}: {frame!r} is in {link.parent!r} and in {parent!r}: a frame of "
                    "transforms has one parent"
                )
            link.times.append(seconds(one.header.stamp, received))
            link.motions.extend(_numbers(one))
    return links


def _numbers(message: Any) -> list[float]:
    if hasattr(message, "transform"):
        at, turn = message.transform.translation, message.transform.rotation
    else:
        pose = getattr(message.pose, "pose", message.pose)
        at, turn = pose.position, pose.orientation
    return [at.x, at.y, at.z, turn.w, turn.x, turn.y, turn.z]


def _way(path: Path, links: dict[str, _Link], camera: str) -> Iterator[str]:
    """The frames with a parent from the camera's to the root."""
    passed: set[str] = set()
    while camera in links:
        if camera in passed:
            raise ValueError(f"{path}: transforms lead from {camera!r} back to itself")
        passed.add(camera)
        yield camera
        camera = links[camera].parent


def _poses_in_world(path: Path, links: dict[str, _Link], camera: str, times: Array) -> Array:
    """Poses world_from_camera (n, 3, 4)."""
    poses = np.tile(np.eye(3, 4), (len(times), 1, 1))
    if camera not in links:
        known = ", ".join(sorted(links)[:10]) or "none"
        raise ValueError(
            f"{path}: nothing says where the images' frame {camera!r} is; frames with a parent are "
            f"{known}"
        )
    for frame in _way(path, links, camera):
        try:
            link = links[frame].at(times)
        except ValueError as error:
            raise ValueError(f"{path}: the pose of {frame!r}: {error}") from None
        poses[..., 3] = (link[..., :3] @ poses[..., 3:])[..., 0] + link[..., 3]
        poses[..., :3] = link[..., :3] @ poses[..., :3]
    return poses


def write_poses(path: Path, times: Array, cam_from_world: Array) -> None:
    """Write poses (n, 3, 4) to an MCAP file of ROS 2 messages, as PoseStamped and on /tf.

    Args:
        path: the file.
        times: (n,) seconds.
        cam_from_world: (n, 3, 4) poses.
    """
    rosbag2, typesys = optional("rosbags.rosbag2"), optional("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    types = {name.rpartition("/")[2]: made for name, made in store.types.items()}
    with tempfile.TemporaryDirectory(prefix="protomark-") as folder:
        bag = Path(folder) / "bag"
        plugin = rosbag2.StoragePlugin.MCAP
        with rosbag2.Writer(bag, version=9, storage_plugin=plugin) as writer:
            pose_type, tf_type = "geometry_msgs/msg/PoseStamped", _TF[0]
            poses, transforms = (
                writer.add_connection(topic, kind, typestore=store)
                for topic, kind in ((POSE_TOPIC, pose_type), ("/tf", tf_type))
            )
            for time, pose in zip(times, cam_from_world, strict=True):
                nanoseconds = round(time * 1e9)
                header = types["Header"](types["Time"](*divmod(nanoseconds, 10**9)), WORLD)
                w, x, y, z = quaternion_from_rotation(pose[:, :3].T)
                turn, at = types["Quaternion"](x, y, z, w), camera_centers(pose).tolist()
                stamped = types["PoseStamped"](header, types["Pose"](types["Point"](*at), turn))
                moved = types["Transform"](types["Vector3"](*at), turn)
                link = types["TransformStamped"](header, CAMERA, moved)
                tree = types["TFMessage"]([link])
                writer.write(poses, nanoseconds, store.serialize_cdr(stamped, pose_type))
                writer.write(transforms, nanoseconds, store.serialize_cdr(tree, tf_type))
        with replacing(path) as file:
            file.write(next(bag.glob("*.mcap")).read_bytes())
