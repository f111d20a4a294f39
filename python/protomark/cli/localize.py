"""The command `protomark localize`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from protomark.cli.options import BagTopic, JsonFile, MaxQueryKeypoints, MaxSize, Recall, Threads

if TYPE_CHECKING:
    from protomark.localization.batch import LocalizationBatch


def localize(
    scene: Annotated[
        Path,
        typer.Argument(
            metavar="MAP", help="Map file (.pmk) with positions, or a folder of `protomark map`."
        ),
    ],
    images: Annotated[
        list[Path], typer.Argument(metavar="IMAGES", help="Images, folders, videos, ROS bags.")
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help="Folder for images.txt, cameras.txt (COLMAP), trajectory.txt (TUM) and poses.csv.",
        ),
    ] = Path("localized"),
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="CAMERA",
            help="COLMAP's cameras.txt, a folder with a COLMAP model, or a camera written out: "
            "PINHOLE:525,525,320,240. Without it: that of a ROS bag, or the camera that the map "
            "was made with, for images of its size. 'estimate', and for other images: by EXIF data "
            "and matches.",
        ),
    ] = None,
    refine_focal_length: Annotated[
        bool,
        typer.Option(
            "--refine-focal-length", help="Refine the camera's focal length for each image."
        ),
    ] = False,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="True poses in the map's world, to measure recall: a COLMAP images.txt or model, "
            "a TUM trajectory whose time stamps are the images' names, or a bag's topic (/tf)."
        ),
    ] = None,
    priors: Annotated[
        Path | None,
        typer.Option(
            help="Rough poses in the same formats: only landmarks that are visible from them are "
            "searched."
        ),
    ] = None,
    prior_distance: Annotated[
        float | None,
        typer.Option(help="Largest error in the map's unit.", show_default="1"),
    ] = None,
    prior_degrees: Annotated[
        float | None, typer.Option(help="Largest error in degrees.", show_default="15")
    ] = None,
    min_confidence: Annotated[
        float,
        typer.Option(
            min=0,
            max=1,
            help="Smallest probability of a pose in images.txt; poses.csv lists every image.",
        ),
    ] = 0.9,
    every: Annotated[int, typer.Option(help="Take every n-th image or frame only.")] = 1,
    topic: BagTopic = None,
    max_keypoints: MaxQueryKeypoints = None,
    max_size: MaxSize = 1600,
    recall: Recall = None,
    threads: Threads = 0,
    mcap: Annotated[
        Path | None,
        typer.Option(help="Also write the poses to this MCAP file, for Foxglove and ROS 2."),
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Find where images were taken in a map, and how sure that is.

    Reads a learning map or a sealed one, and images. Writes their poses, each with the probability
    that it is right. An image that cannot be read, or was taken elsewhere, does not end the run;
    the exit code is 1 if no pose is found.

    protomark localize kitchen new-photos/
    """
    from protomark.cli.terminal import note, progress_bar, write_json
    from protomark.extras import optional
    from protomark.features.bag import is_bag
    from protomark.features.bag_poses import write_poses
    from protomark.features.images import describe_folder
    from protomark.files import check_outputs, only_writer
    from protomark.localization.batch import LocalizationRequest, localize_files

    check_outputs(json_file, mcap, inputs=[scene, *images, camera, poses, priors], folder=output)
    if priors is None and (prior_distance is not None or prior_degrees is not None):
        raise ValueError("--prior-distance and --prior-degrees are of --priors, which is missing")
    if mcap is not None:
        if mcap.suffix != ".mcap":
            raise ValueError(f"--mcap {mcap}: name a file that ends in .mcap")
        if mcap.exists():
            raise ValueError(f"--mcap {mcap} exists, and may be a recording: name a new file")
        optional("rosbags")
    for path in images:
        for line in [] if is_bag(path) else describe_folder(path):
            note(line)
    request = LocalizationRequest(
        scene,
        images,
        every=every,
        topic=topic,
        camera=camera,
        refine_focal_length=refine_focal_length,
        true_poses=poses,
        priors=priors,
        prior_distance=1.0 if prior_distance is None else prior_distance,
        prior_degrees=15.0 if prior_degrees is None else prior_degrees,
        min_confidence=min_confidence,
        max_keypoints=max_keypoints,
        max_size=max_size,
        recall=recall,
        threads=threads,
    )
    with only_writer(output), progress_bar() as progress:
        batch = localize_files(request, output, progress)
    if mcap is not None:
        write_poses(mcap, *batch.trajectory())
    write_json(json_file, batch.as_dict())
    _show(batch, output)
    if batch.interrupted:
        raise typer.Exit(130)
    if not batch.summary()["localized"]:
        raise typer.Exit(1)


def _show(batch: LocalizationBatch, output: Path) -> None:
    from protomark.cli.terminal import console, note, print_facts
    from protomark.localization.batch import CAMERAS, POSES, TABLE, TRAJECTORY

    facts = batch.summary()
    rows = [
        ("images", f"{facts['images']:,}"),
        ("localized", f"{facts['localized']:,} (confidence {batch.min_confidence:g} or more)"),
        ("not found", f"{facts['images'] - facts['localized'] - facts['unreadable']:,}"),
    ]
    if facts["unreadable"]:
        rows.append(("not usable", f"{facts['unreadable']:,}"))
    rows += [("", f"{len(told)} as {told[0]}") for told in batch.reasons().values()]
    if facts["median_inliers"] is not None:
        rows.append(("median inliers", f"{facts['median_inliers']:,.0f}"))
    times = facts["median_seconds"]
    if times:
        text = ", ".join(f"{stage} {1000 * times[stage]:.1f}" for stage in times)
        rows.append(("median milliseconds", text))
    for row in facts["recall"]:
        label = f"recall at {row['distance']:g}, {row['degrees']:g} degrees"
        rows.append((label, f"{row['recall']:.3f} of {facts['with_true_pose']:,}"))
    if facts["median_position_error"] is not None:
        text = f"{facts['median_position_error']:.4g}, {facts['median_angle_error']:.3g} degrees"
        rows.append(("median error of localized", text))
    print_facts(rows)
    if sentence := batch.contradiction():
        note(f"warning: {sentence}")
    files = f"{output / POSES}, {CAMERAS}, {TRAJECTORY} and {TABLE}"
    console.print(files, markup=False, highlight=False, soft_wrap=True)
