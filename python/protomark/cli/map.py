"""The command `protomark map`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

_NAMES_SHOWN = 3


def map_(
    images: Annotated[
        Path, typer.Argument(metavar="IMAGES_OR_VIDEO", help="Folder of images, or a video file.")
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for the new map.")
    ] = None,
    into: Annotated[
        Path | None,
        typer.Option("--into", help="A map that `protomark map` made: extend it, in place."),
    ] = None,
    descriptor: Annotated[
        str,
        typer.Option(
            "--descriptor", "-d", help="freak, orb, brisk, akaze, latch, beblid or teblid."
        ),
    ] = "akaze",
    camera: Annotated[
        str | None,
        typer.Option(
            help="A COLMAP cameras.txt, a folder with a COLMAP model, or a camera written out: "
            "PINHOLE:525,525,320,240 or 'PINHOLE 640 480 525 525 320 240'. By default it is "
            "calibrated while mapping."
        ),
    ] = None,
    focal: Annotated[
        float | None,
        typer.Option(
            help="Focal length to begin with, pixels; by default EXIF's, else 1.2 times the longer "
            "side."
        ),
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="Given poses, for which only landmarks are made: COLMAP model folder or "
            "images.txt, or a TUM trajectory."
        ),
    ] = None,
    every: Annotated[int, typer.Option(help="Take every n-th frame only.")] = 1,
    window: Annotated[
        int,
        typer.Option(
            help="Number of latest keyframes that keep their descriptors, to make landmarks."
        ),
    ] = 8,
    dim: Annotated[int, typer.Option(help="Dimensions of a prototype.")] = 32,
    encoder: Annotated[
        str, typer.Option(help="Name or file of the encoder; by default the descriptor's own.")
    ] = "",
    max_keypoints: Annotated[
        int, typer.Option(help="Keypoints kept in a frame, strongest first, spread over it.")
    ] = 2000,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue a map that Ctrl-C or a crash ended.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Make the map anew even if OUTPUT holds one.")
    ] = False,
    view: Annotated[
        bool,
        typer.Option("--view", help="Also write recording.rrd for the Rerun viewer."),
    ] = False,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads to search and adjust on.")] = 1,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file.")
    ] = None,
) -> None:
    r"""Map a scene from images or a video: structure from motion.

    Frame by frame, each image is matched with the prototypes of the map and updates those it sees;
    only the last few keyframes keep descriptors. OUTPUT gets scene.pmk (the map), sparse/ (a COLMAP
    model), trajectory.txt (TUM format), report.html and report.json.

    protomark map walk.mp4 -o kitchen

    protomark map more-images/ --into kitchen

    protomark localize kitchen new-images/

    Ctrl-C writes the map so far, and the same command with --resume continues it. docs/mapping.md
    explains the pipeline.
    """
    from protomark.cli.terminal import check_outputs, note, progress_bar, write_json
    from protomark.extras import optional
    from protomark.mapping.options import MappingOptions
    from protomark.mapping.session import MappingInterrupted, MapRequest, make_map

    scene = output or into
    if scene is None or (output is not None and into is not None):
        raise ValueError(
            "name either a folder for the new map with -o, or a map to extend with --into"
        )
    check_outputs(json_file)
    if view:
        optional("rerun")
    request = MapRequest(
        images=images,
        output=scene,
        options=MappingOptions(
            descriptor=descriptor,
            max_keypoints=max_keypoints,
            encoder=encoder,
            dim=dim,
            window=window,
        ),
        camera=camera,
        focal=focal,
        poses=poses,
        every=every,
        resume=resume,
        extend=into is not None,
        force=force,
        record=view,
        threads=threads,
    )
    try:
        with progress_bar() as progress:
            figures = make_map(request, progress, note)
    except MappingInterrupted:
        note(f"stopped: the map so far is in {scene}; the same command with --resume continues it")
        raise typer.Exit(130) from None
    write_json(json_file, figures)
    _show(figures, scene)


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
    say(
        f"  {figures['seconds_total']:.1f} s, {figures['frames_per_second']:.1f} frames per "
        f"second; see {scene / 'report.html'}"
    )
    for reason, names in figures["not_registered"].items():
        shown = ", ".join(names[:_NAMES_SHOWN])
        more = f" and {len(names) - _NAMES_SHOWN} more" if len(names) > _NAMES_SHOWN else ""
        say(f"  [yellow]without a pose[/]: {escape(shown)}{more}: {escape(reason)}")
    say(f"  next: protomark localize {escape(str(scene))} IMAGES")
