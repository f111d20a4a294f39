"""What `protomark map` is asked to do, and whether that can be done."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from protomark.files import STATE
from protomark.geometry.camera import Camera
from protomark.mapping.options import MappingOptions
from protomark.mapping.source import FrameSource
from protomark.mapping.state import CHECKPOINT


@dataclass(frozen=True)
class MapRequest:
    """What to map, and how."""

    images: Path  # folder of images, video or ROS bag
    output: Path  # folder of the map
    options: MappingOptions  # how to make it; a map that is resumed or extended keeps its own
    # A cameras.txt, a COLMAP model, or a camera written out; None: calibrate while mapping.
    camera: str | None = None
    focal: float | None = None  # focal length to start calibration with, pixels
    poses: Path | None = None  # file, folder or topic of known poses
    mask: Path | None = None  # image that is black where the scene must not be looked at
    every: int = 1  # take every n-th frame only
    topic: str | None = None  # of a ROS bag's images; None: the only one with images
    resume: bool = False  # whether to continue an interrupted map
    extend: bool = False  # whether to add the images to the existing map in `output`
    force: bool = False  # whether to replace an existing map
    record: bool = False  # whether to write a Rerun recording, too
    seal: bool = True  # whether to write a sealed map, too
    threads: int = 1  # threads to search and adjust on
    # Names of the options that the user chose, not left at their defaults; extending a map that was
    # made with others is refused.
    chosen: frozenset[str] = frozenset()


def check_output(request: MapRequest) -> None:
    """Raise before any work if the output folder is not what the request needs."""
    scene = request.output
    interrupted = (scene / CHECKPOINT).is_dir()
    if request.resume:
        if not interrupted:
            raise FileNotFoundError(
                f"{scene} holds no interrupted map: start a new one without --resume"
            )
        return
    if request.extend:
        if interrupted:
            raise FileExistsError(
                f"{scene} holds an interrupted map: finish it with --resume first"
            )
        return
    if all(path.name.startswith(".lock") for path in scene.iterdir()):
        return
    is_map = interrupted or (scene / STATE).exists()
    if request.force and is_map:
        return
    if interrupted:
        raise FileExistsError(
            f"{scene} holds an interrupted map: --resume continues it, --force starts anew"
        )
    if is_map:
        raise FileExistsError(
            f"{scene} holds a map already: --into {scene} extends it, --force makes it anew"
        )
    raise FileExistsError(f"{scene} holds other files: name another folder with -o")


def request_facts(request: MapRequest, source: FrameSource) -> dict[str, Any]:
    """What must be the same when a map is resumed, as JSON values: the input, and the options."""
    names = "\n".join(sorted(source.names()))
    return {
        "the input": str(source.path.resolve()),
        "--every": request.every,
        "--topic": request.topic,
        "the images": hashlib.sha256(names.encode(errors="surrogateescape")).hexdigest()[:16],
        "--camera": request.camera,
        "--focal": request.focal,
        "--poses": None if request.poses is None else str(request.poses.resolve()),
        "--mask": None if request.mask is None else str(request.mask.resolve()),
        **{_option(name): value for name, value in asdict(request.options).items()},
    }


def check_same_request(scene: Path, now: dict[str, Any], before: dict[str, Any]) -> None:
    """Raise ValueError if an interrupted map was made from something else or otherwise."""
    for name, value in now.items():
        if value != before.get(name):
            was = "other ones" if name == "the images" else before.get(name)
            told = "these" if name == "the images" else value
            raise ValueError(
                f"{scene}: {name} of the interrupted map: {was}, now: {told}: resume it with the "
                "same command, or make it anew with --force"
            )


def check_same_options(request: MapRequest, options: MappingOptions) -> None:
    """Raise ValueError if a map is to be extended with other options than it was made with."""
    if (request.poses is not None) != options.fixed_poses:
        raise ValueError(
            f"{request.output} was made {'with' if options.fixed_poses else 'without'} --poses: "
            "extend it likewise, or make another map with -o"
        )
    if "focal" in request.chosen:
        raise ValueError(
            f"--focal is for a new map: {request.output} has its camera already, give the one of "
            "these images with --camera"
        )
    for name, value in asdict(options).items():
        asked = getattr(request.options, name)
        if name in request.chosen and asked != value:
            raise ValueError(
                f"{_option(name)} {asked}: {request.output} was made with {value}, so leave the "
                "option out, or make another map with -o"
            )


def same_camera(request: MapRequest, cameras: Iterable[Camera], given: Camera) -> Camera:
    """The camera of a map that is the given one, or this if none has its size.

    Raises:
        ValueError: the map has another camera of that size.
    """
    sized = [c for c in cameras if (c.width, c.height) == (given.width, given.height)]
    for camera in sized:
        if camera.resembles(given):
            return camera
    if sized:
        told = f"--camera {request.camera}" if request.camera else f"the camera of {request.images}"
        raise ValueError(
            f"{told}: {request.output} was made with {sized[-1]}: leave the "
            "option out, or, for images of another lens, give a COLMAP model that names their "
            "cameras"
        )
    return given


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"
