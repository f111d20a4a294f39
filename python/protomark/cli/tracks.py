"""`protomark tracks`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def tracks(
    folders: Annotated[
        list[Path],
        typer.Argument(
            metavar="FOLDER",
            help="Sequences: each holds images/ and a COLMAP model in sparse/ or sparse/0/.",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder for the files FOLDER.DESCRIPTOR.safetensors."),
    ],
    descriptors: Annotated[
        list[str] | None,
        typer.Option(
            "--descriptor",
            "-d",
            help="freak, orb, brisk, akaze, latch, beblid or teblid; may be repeated.",
            show_default="freak",
        ),
    ] = None,
    images: Annotated[
        Path | None, typer.Option("--images", help="Folder of the images, if not FOLDER/images.")
    ] = None,
    model: Annotated[
        Path | None, typer.Option("--model", help="Folder of the COLMAP model, text or binary.")
    ] = None,
    database: Annotated[
        Path | None,
        typer.Option(
            "--database",
            help="COLMAP database that already holds binary descriptors: they and the model's "
            "points become the tracks, images are not read.",
        ),
    ] = None,
    max_keypoints: Annotated[
        int, typer.Option(help="Keypoints kept in an image, strongest first, spread over it.")
    ] = 2000,
    partners: Annotated[
        int, typer.Option(help="About how many keyframes each keyframe is matched with.")
    ] = 24,
    ratio: Annotated[float, typer.Option(help="Ratio test of matching, in (0, 1].")] = 0.8,
    max_error: Annotated[
        float, typer.Option(help="Largest epipolar and reprojection error, pixels.")
    ] = 3.0,
    min_angle: Annotated[
        float, typer.Option(help="Smallest angle between two rays of a landmark, degrees.")
    ] = 1.0,
    min_length: Annotated[int, typer.Option(help="Fewest observations of a landmark.")] = 3,
    refine_poses: Annotated[
        str,
        typer.Option(
            help="yes, no, or auto: bundle adjustment where the matches say that the given poses "
            "are only roughly right."
        ),
    ] = "auto",
    max_unlabelled: Annotated[
        int | None,
        typer.Option(
            help="Keypoints without a landmark kept in a keyframe, the strongest (smaller files)."
        ),
    ] = None,
    variants: Annotated[
        int,
        typer.Option(
            help="Also write FOLDER.DESCRIPTOR.varied.safetensors, to train on: with this many "
            "copies of each image, warped and with other light, blur and noise."
        ),
    ] = 0,
    threads: Annotated[
        int, typer.Option(help="CPU threads, 0 for one a core; the result is the same.")
    ] = 0,
    force: Annotated[
        bool, typer.Option("--force", help="Make files anew that are there and up to date.")
    ] = False,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file.")
    ] = None,
) -> None:
    """Make tracks from images with known poses: keypoints, descriptors and their landmarks.

    A file that is there already is kept if it was made with these options from this input.
    """
    import os

    from protomark.tracks.command import make_tracks
    from protomark.tracks.extract import Settings

    settings = [
        Settings(
            descriptor=name,
            max_keypoints=max_keypoints,
            partners=partners,
            ratio=ratio,
            max_error=max_error,
            min_angle=min_angle,
            min_length=min_length,
            refine_poses=refine_poses,
            max_unlabelled=max_unlabelled,
        )
        for name in dict.fromkeys(descriptors or ["freak"])
    ]
    make_tracks(
        folders,
        settings,
        output,
        images=images,
        model=model,
        database=database,
        variants=variants,
        force=force,
        threads=threads if threads > 0 else os.cpu_count() or 1,
        json_path=json_file,
    )
