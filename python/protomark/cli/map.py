"""The command `protomark map`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from protomark.cli.options import CameraText, EncoderName, JsonFile, MaxKeypoints, Threads

_NAMES_SHOWN = 3


def map_(
    ctx: typer.Context,
    images: Annotated[
        Path, typer.Argument(metavar="IMAGES_OR_VIDEO", help="Folder of images, or a video file.")
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for the new map.")
    ] = None,
    into: Annotated[
        Path | None, typer.Option("--into", help="Folder of an existing map to extend in place.")
    ] = None,
    descriptor: Annotated[
        str,
        typer.Option(
            "--descriptor", "-d", help="freak, orb, brisk, akaze, latch, beblid or teblid."
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
            "TUM trajectory."
        ),
    ] = None,
    mask: Annotated[
        Path | None,
        typer.Option(help="Image that is black where the camera sees no scene, as in COLMAP."),
    ] = None,
    every: Annotated[int, typer.Option(help="Take every n-th frame only.")] = 1,
    window: Annotated[
        int,
        typer.Option(
            help="Number of latest keyframes that keep their descriptors, to triangulate landmarks."
        ),
    ] = 8,
    dim: Annotated[int, typer.Option(help="Numbers per prototype, one byte each.")] = 32,
    encoder: EncoderName = None,
    max_keypoints: MaxKeypoints = 2000,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue a map that Ctrl-C or a crash ended.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Make the map anew even if OUTPUT holds one.")
    ] = False,
    view: Annotated[
        bool, typer.Option("--view", help="Also write recording.rrd for the Rerun viewer.")
    ] = False,
    no_seal: Annotated[
        bool, typer.Option("--no-seal", help="Write the learning map only, no sealed one.")
    ] = False,
    threads: Threads = 1,
    json_file: JsonFile = None,
) -> None:
    """Map a scene from images or a video: structure from motion.

    Matches frame by frame with the prototypes of the map, which learn from each match; only the
    latest keyframes keep descriptors. OUTPUT gets scene.pmk (the map, which learns),
    scene.sealed.pmk (what ships: 33 bytes per landmark and its position), sparse/ (a COLMAP
    model), trajectory.txt (TUM format), report.html and report.json.

    protomark map walk.mp4 -o kitchen

    protomark map more-images/ --into kitchen

    protomark localize kitchen new-images/

    Ctrl-C writes the map so far, and the same command with --resume continues it. The exit code is
    1 if there is no map, or one that cannot be trusted: sentences say why.
    """
    from protomark.cli.terminal import check_outputs, note, progress_bar, write_json
    from protomark.extras import optional
    from protomark.mapping.options import MappingOptions
    from protomark.mapping.request import MapRequest
    from protomark.mapping.session import make_map
    from protomark.threads import available_threads

    scene = output or into
    if scene is None or (output is not None and into is not None):
        raise ValueError(
            "name either a folder for a new map with -o, or a map to extend with --into"
        )
    check_outputs(json_file, inputs=[images, camera, poses, mask, encoder])
    if view:
        optional("rerun")
    request = MapRequest(
        images=images,
        output=scene,
        options=MappingOptions(
            descriptor=descriptor,
            max_keypoints=max_keypoints,
            encoder=encoder or "",
            dim=dim,
            window=window,
        ),
        camera=camera,
        focal=focal,
        poses=poses,
        mask=mask,
        every=every,
        resume=resume,
        extend=into is not None,
        force=force,
        record=view,
        seal=not no_seal,
        threads=threads or available_threads(),
        chosen=frozenset(name for name in ctx.params if _is_chosen(ctx, name)),
    )
    with progress_bar() as progress:
        figures = make_map(request, progress, note)
    write_json(json_file, figures)
    _show(figures, scene)
    if figures["warnings"]:
        raise typer.Exit(1)


def _is_chosen(ctx: typer.Context, name: str) -> bool:
    source = ctx.get_parameter_source(name)
    return source is not None and source.name != "DEFAULT"


def _show(figures: dict[str, Any], scene: Path) -> None:
    from rich.markup import escape

    from protomark.cli.terminal import say

    ratio = figures["descriptor_bytes"] / max(figures["memory_bytes"], 1)
    say(f"[bold]{escape(str(scene))}[/]")
    say(
        f"  {figures['registered']} of {figures['frames']} frames registered, "
        f"{figures['keyframes']} keyframes, {figures['landmarks']} landmarks, "
        f"{figures['observations']} observations ({figures['track_length_mean']:.1f} per landmark)"
    )
    say(
        f"  reprojection error: mean {figures['reprojection_error_mean']:.2f} pixels, "
        f"median {figures['reprojection_error_median']:.2f}"
    )
    say(
        f"  memory for matching: {figures['memory_bytes'] / 1e6:.2f} MB, "
        f"{figures['bytes_per_landmark']:.0f} bytes per landmark; all descriptors: "
        f"{figures['descriptor_bytes'] / 1e6:.2f} MB, {ratio:.1f} times as much"
    )
    if "sealed_bytes" in figures:
        say(f"  sealed map: {figures['sealed_bytes'] / 1e6:.2f} MB, with encoder and positions")
    say(
        f"  {figures['seconds_total']:.1f} s, {figures['frames_per_second']:.1f} frames per "
        f"second; see {scene / 'report.html'}"
    )
    for reason, names in figures["not_registered"].items():
        shown = ", ".join(names[:_NAMES_SHOWN])
        more = f" and {len(names) - _NAMES_SHOWN} more" if len(names) > _NAMES_SHOWN else ""
        say(f"  [yellow]without a pose[/]: {escape(shown)}{more}: {escape(reason)}")
    if figures["left_out"]:
        say(f"  left out: {escape(figures['left_out'])}")
    for warning in figures["warnings"]:
        say(f"  [red]cannot be trusted[/]: {escape(warning)}")
    if not figures["warnings"]:
        say(f"  next: protomark localize {escape(str(scene))} IMAGES")
