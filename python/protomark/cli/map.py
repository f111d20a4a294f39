"""`protomark map`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protomark.cli.options import write_json


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
            "calibrated along the way."
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
            help="Given poses, then only landmarks are made: COLMAP model folder or images.txt, or "
            "a TUM trajectory."
        ),
    ] = None,
    every: Annotated[int, typer.Option(help="Take every n-th frame only.")] = 1,
    window: Annotated[
        int,
        typer.Option(help="Last keyframes that keep their descriptors, to make new landmarks."),
    ] = 8,
    dim: Annotated[int, typer.Option(help="Dimensions of a prototype.")] = 32,
    encoder: Annotated[
        str, typer.Option(help="Name or file of the encoder; by default the descriptor's own.")
    ] = "",
    memory: Annotated[
        str,
        typer.Option(
            help="What the map keeps: prototypes; or, to compare, medoids (one descriptor a "
            "landmark) or descriptors (all of them)."
        ),
    ] = "prototypes",
    max_keypoints: Annotated[
        int, typer.Option(help="Keypoints kept in a frame, strongest first, spread over it.")
    ] = 2000,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a map that Ctrl-C or a crash ended.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Make the map anew, though OUTPUT holds one.")
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
    r"""Make a map of a scene from images or a video, as they come: structure from motion.

    Each frame is matched with the prototypes of the map, updates those it sees, and is forgotten;
    only the last few keyframes keep descriptors. OUTPUT gets scene.pmk (the map), sparse/ (a COLMAP
    model), trajectory.txt (TUM format), report.html and report.json.

    protomark map walk.mp4 -o kitchen

    protomark map more-images/ --into kitchen

    Ctrl-C ends with what there is, and the same command with --resume goes on. --view needs
    `pip install protomark\[view]`. docs/mapping.md explains the pipeline.
    """
    from protomark.evaluation.command import check_outputs
    from protomark.mapping import command
    from protomark.mapping.settings import Settings

    if (output is None) == (into is None):
        raise ValueError("name a folder for the new map with -o, or a map to extend with --into")
    check_outputs(json_file)
    scene = output or into or Path()
    request = command.Request(
        images=images,
        output=scene,
        settings=Settings(
            descriptor=descriptor,
            max_keypoints=max_keypoints,
            memory=memory,
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
        view=view,
        threads=threads,
    )
    try:
        figures = command.make_map(request)
    except (command.Interrupted, KeyboardInterrupt):
        command.explain_interruption(scene)
        raise typer.Exit(130) from None
    write_json(json_file, figures)
    command.show(figures, scene)
