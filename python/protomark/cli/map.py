"""The command `protomark map`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Any

import typer

from protomark.cli.options import (
    BagTopic,
    CameraText,
    EncoderName,
    JsonFile,
    MaxKeypoints,
    MaxSize,
    NoSeal,
    Threads,
    chosen_options,
)


def map_(
    ctx: typer.Context,
    images: Annotated[
        Path,
        typer.Argument(
            metavar="IMAGES",
            help="Folder of images, a video file, or a ROS bag (.bag, .mcap, .db3).",
        ),
    ],
    output: Annotated[Path | None, typer.Option("--output", "-o", help="New map's folder.")] = None,
    into: Annotated[Path | None, typer.Option("--into", help="Folder of a map to extend.")] = None,
    descriptor: Annotated[
        str,
        typer.Option(
            "--descriptor", "-d", help="freak, orb, brisk, akaze, latch, beblid, teblid or sift."
        ),
    ] = "akaze",
    camera: CameraText = None,
    focal: Annotated[
        float | None,
        typer.Option(
            help="Focal length to start calibration with, pixels; by default that of EXIF data, "
            "else what most pairs of the first frames agree on."
        ),
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="Known poses, which are not adjusted: a COLMAP model folder or images.txt, or a "
            "TUM trajectory, or a bag's topic: /tf, or one of odometry or the camera's poses."
        ),
    ] = None,
    mask: Annotated[
        Path | None,
        typer.Option(help="Image that is black where the camera sees no scene, as in COLMAP."),
    ] = None,
    every: Annotated[int, typer.Option(help="Take every n-th frame only.")] = 1,
    topic: BagTopic = None,
    window: Annotated[
        int,
        typer.Option(
            help="Number of latest keyframes that keep their descriptors, to triangulate landmarks."
        ),
    ] = 8,
    dim: Annotated[int, typer.Option(help="Numbers per prototype.")] = 48,
    encoder: EncoderName = None,
    max_keypoints: MaxKeypoints = 2000,
    max_size: MaxSize = 1600,
    resume: Annotated[bool, typer.Option("--resume", help="Continue an interrupted map.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace the map in OUTPUT.")] = False,
    view: Annotated[bool, typer.Option("--view", help="Also write a recording for Rerun.")] = False,
    no_seal: NoSeal = False,
    threads: Threads = 1,
    json_file: JsonFile = None,
) -> None:
    """Map a scene from images, a video or a ROS bag: structure from motion.

    Matches frame by frame with the prototypes of the map, which learn from each match; only the
    latest keyframes keep descriptors. OUTPUT gets scene.pmk (the map, which learns),
    scene.sealed.pmk (what ships: 33 bytes per landmark and its position), sparse/ (a COLMAP
    model), trajectory.txt (TUM format), report.html and report.json.

    protomark map walk.mp4 -o kitchen

    protomark map run.mcap --topic /camera/image_raw -o kitchen

    protomark map more-images/ --into kitchen

    protomark localize kitchen new-images/

    Ctrl-C writes the map so far, and the same command with --resume continues it. The exit code is
    1 if there is no map, or one that cannot be trusted: sentences say why.
    """
    from protomark.cli.terminal import note, progress_bar, write_json
    from protomark.extras import optional
    from protomark.features.bag import is_bag
    from protomark.features.images import describe_folder
    from protomark.files import check_outputs
    from protomark.mapping.options import MappingOptions
    from protomark.mapping.request import MapRequest
    from protomark.mapping.session import make_map

    scene = output or into
    if scene is None or (output is not None and into is not None):
        raise ValueError(
            "name either a folder for a new map with -o, or a map to extend with --into"
        )
    if force and (resume or into is not None):
        raise ValueError("--force makes a map anew: leave out --resume and --into")
    check_outputs(json_file, inputs=[images, camera, poses, mask, encoder], folder=scene)
    inner = images / "images"
    for line in [] if is_bag(images) else describe_folder(inner if inner.is_dir() else images):
        note(line)
    if view:
        optional("rerun")
    request = MapRequest(
        images=images,
        output=scene,
        options=MappingOptions(
            descriptor=descriptor,
            max_keypoints=max_keypoints,
            max_size=max_size,
            encoder=encoder or "",
            dim=dim,
            window=window,
        ),
        camera=camera,
        focal=focal,
        poses=poses,
        mask=mask,
        every=every,
        topic=topic,
        resume=resume,
        extend=into is not None,
        force=force,
        record=view,
        seal=not no_seal,
        threads=threads,
        chosen=chosen_options(ctx),
    )
    with progress_bar() as progress:
        figures = make_map(request, progress, note)
    write_json(json_file, figures)
    _show(figures, scene)
    if figures["warnings"]:
        raise typer.Exit(1)


def _show(figures: dict[str, Any], scene: Path) -> None:
    from rich.markup import escape

    from protomark.cli.terminal import print_facts, say
    from protomark.report import first_of, map_rows

    print_facts([("map", f"{scene}, see {scene / 'report.html'}"), *map_rows(figures)])
    for reason, names in figures["not_registered"].items():
        say(f"  [yellow]without a pose[/]: {escape(first_of(names))}: {escape(reason)}")
    for warning in figures["warnings"]:
        say(f"  [red]cannot be trusted[/]: {escape(warning)}")
    if not figures["warnings"]:
        say(f"  next: protomark localize {escape(shlex.quote(str(scene)))} IMAGES")
