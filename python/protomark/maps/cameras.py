"""The cameras that a map was made with, in its metadata as lines of COLMAP's cameras.txt."""

from __future__ import annotations

from collections.abc import Iterable

import protomark as pm
from protomark.geometry.camera import Camera
from protomark.geometry.camera_files import CameraSet

KEY = "cameras"


def cameras_text(cameras: Iterable[Camera]) -> str:
    """The text that a map's metadata hold under `KEY`: each different camera on a line."""
    lines = sorted({str(camera) for camera in cameras})
    return "".join(f"{number} {line}\n" for number, line in enumerate(lines, 1))


def map_cameras(scene: pm.PrototypeMap | pm.SealedMap | pm.ShardedMap) -> CameraSet:
    """The cameras that a map was made with; none if nobody stored them."""
    cameras = []
    for line in scene.metadata.get(KEY, "").splitlines():
        try:
            camera = Camera.parse(line.partition(" ")[2])
            camera.check()
        except ValueError as error:
            raise ValueError(f"the map's metadata {KEY!r} hold no COLMAP camera: {error}") from None
        cameras.append(camera)
    return CameraSet(tuple(cameras))


def joint_cameras(target: pm.PrototypeMap, source: pm.PrototypeMap) -> str:
    """The text of a map's cameras, and of those of another map that resemble none of them."""
    cameras, others = (list(map_cameras(scene).cameras) for scene in (target, source))
    new = [c for c in others if not any(c.resembles(known) for known in cameras)]
    return cameras_text([*cameras, *new])
