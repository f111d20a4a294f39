"""`protomark localize`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protomark.cli.options import write_json


def localize(
    scene: Annotated[Path, typer.Argument(help="Map file (.pmk) whose landmarks have positions.")],
    images: Annotated[list[Path], typer.Argument(help="Images, or folders of images.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="Folder for images.txt, cameras.txt (COLMAP) and poses.csv."
        ),
    ] = Path("localized"),
    camera: Annotated[
        str | None,
        typer.Option(
            help="A COLMAP cameras.txt, a folder with a COLMAP model, or a camera written out: "
            "PINHOLE:525,525,320,240 or 'PINHOLE 640 480 525 525 320 240'. By default the focal "
            "length comes from EXIF data, or is estimated from matches."
        ),
    ] = None,
    refine_focal_length: Annotated[
        bool, typer.Option("--refine-focal-length", help="Refine it for each image.")
    ] = False,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="True poses in the map's world, to measure recall: a COLMAP images.txt or model, "
            "or a TUM trajectory whose time stamps are the images' names."
        ),
    ] = None,
    priors: Annotated[
        Path | None,
        typer.Option(
            help="Rough poses, in the same formats: only landmarks that they make visible are "
            "searched."
        ),
    ] = None,
    prior_distance: Annotated[
        float, typer.Option(help="How far off a rough pose may be, in the map's units.")
    ] = 1.0,
    prior_degrees: Annotated[
        float, typer.Option(help="How far off its orientation may be, degrees.")
    ] = 15.0,
    min_confidence: Annotated[
        float,
        typer.Option(
            min=0, max=1, help="Poses that are less likely to be right are only in poses.csv."
        ),
    ] = 0.9,
    max_keypoints: Annotated[
        int, typer.Option(min=4, help="Keypoints kept in an image, strongest first.")
    ] = 2000,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads to encode and search.")] = 1,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file.")
    ] = None,
) -> None:
    """Say where images were taken, in a map, with a confidence for each pose.

    A map may be open or sealed; `protomark build` makes one from tracks. An image that cannot be
    read or was taken elsewhere does not end the run. docs/localization.md says more.
    """
    from protomark.evaluation.command import check_outputs
    from protomark.localization.command import Settings, localize_files, show

    check_outputs(json_file)
    results, interrupted = localize_files(
        scene,
        images,
        output,
        Settings(
            camera=camera,
            refine_focal_length=refine_focal_length,
            true_poses=poses,
            priors=priors,
            prior_distance=prior_distance,
            prior_degrees=prior_degrees,
            min_confidence=min_confidence,
            max_keypoints=max_keypoints,
            threads=threads,
        ),
    )
    write_json(json_file, results.as_dict())
    show(results, output)
    if interrupted:
        raise typer.Exit(130)
