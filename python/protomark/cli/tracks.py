"""The command `protomark tracks`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from protomark.cli.options import JsonFile, MaxKeypoints, MaxSize, Threads, chosen_options

_BAR = 30  # characters
# Options for images, which a database and maps of other programs do without.
_OF_IMAGES = {
    *("max_keypoints", "max_size", "partners", "ratio", "max_error", "min_angle", "min_length"),
    *("refine_poses", "max_unlabelled", "augmentations"),
}


def tracks(
    ctx: typer.Context,
    folders: Annotated[
        list[Path],
        typer.Argument(
            metavar="FOLDER",
            help="Sequences: each holds images/ and a COLMAP model in sparse/ or sparse/0/. Or "
            "maps of other programs, see `protomark build`.",
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
            help="freak, orb, brisk, akaze, latch, beblid, teblid or sift; may be repeated.",
            show_default="freak",
        ),
    ] = None,
    images: Annotated[Path | None, typer.Option("--images", help="Folder of the images.")] = None,
    model: Annotated[Path | None, typer.Option("--model", help="COLMAP model's folder.")] = None,
    database: Annotated[
        Path | None,
        typer.Option(
            "--database",
            help="COLMAP database with SIFT or binary descriptors: these and the model's points "
            "become the tracks, and images are not read.",
        ),
    ] = None,
    max_keypoints: MaxKeypoints = 2000,
    max_size: MaxSize = 1600,
    partners: Annotated[int, typer.Option(help="How many keyframes each is matched with.")] = 24,
    ratio: Annotated[
        float,
        typer.Option(help="Ratio test: a match is nearer than this share of the second nearest."),
    ] = 0.8,
    max_error: Annotated[
        float, typer.Option(help="Largest epipolar and reprojection error, pixels.")
    ] = 3.0,
    min_angle: Annotated[float, typer.Option(help="Smallest triangulation angle, degrees.")] = 1.0,
    min_length: Annotated[int, typer.Option(help="Smallest number of observations.")] = 3,
    refine_poses: Annotated[
        str,
        typer.Option(
            help="Whether bundle adjustment refines the given poses: yes, no, or auto: if the "
            "matches do not fit them."
        ),
    ] = "auto",
    max_unlabelled: Annotated[
        int | None,
        typer.Option(
            help="Limit on keypoints without a landmark per keyframe, for smaller files; by "
            "default all are kept."
        ),
    ] = None,
    augmentations: Annotated[
        int,
        typer.Option(
            help="Also write FOLDER.DESCRIPTOR.augmented.safetensors to train on, with this many "
            "copies of each image, warped and with other light, blur and noise."
        ),
    ] = 0,
    threads: Threads = 0,
    force: Annotated[bool, typer.Option("--force", help="Make files anew.")] = False,
    json_file: JsonFile = None,
) -> None:
    """Make tracks from images with known poses.

    Reads images and their COLMAP model. Writes one file per sequence and descriptor with keypoints,
    descriptors, and the landmarks that they observe. A file that was made with these options from
    this input is kept. Maps of other programs keep the descriptors that they have.

    protomark tracks kitchen/ -o tracks -d freak -d orb

    protomark tracks atlas.osa -o tracks
    """
    from protomark.cli.terminal import progress_bar, write_json
    from protomark.files import check_outputs
    from protomark.tracks.extract import TracksOptions, find_sequence
    from protomark.tracks.file import sequence_name
    from protomark.tracks.importers import check_below, find_importer
    from protomark.tracks.make import import_tracks, make_augmented_tracks, make_tracks

    options = [
        TracksOptions(
            descriptor=name,
            max_keypoints=max_keypoints,
            max_size=max_size,
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
    if augmentations < 0:
        raise ValueError(f"--augmentations {augmentations}: give a number of copies, 0 for none")
    if len(folders) > 1 and (images or model or database):
        raise ValueError("--images, --model and --database are for one FOLDER: give only one")
    maps = [
        path
        for path in folders
        if not (images or model or database or (path / "sparse").is_dir())
        and path.exists()
        and find_importer(path)
    ]
    unread = (
        [] if database is None and maps != folders else sorted(chosen_options(ctx) & _OF_IMAGES)
    )
    if descriptors and maps == folders:
        unread.append("descriptor")
    if unread:
        raise ValueError(
            f"--{unread[0].replace('_', '-')} is for images, which are not read: leave it out"
        )
    for folder in folders:
        if not (images or folder in maps or (folder / "images").is_dir()):
            check_below(folder)
    sources = [
        find_sequence(folder, images, model, database) for folder in folders if folder not in maps
    ]
    names = [source.name for source in sources] + [sequence_name(path.resolve()) for path in maps]
    if double := sorted({n for n in names if names.count(n) > 1}):
        raise ValueError(
            f"two folders are named {double[0]} and would write the same file: run the command for "
            "each, with its own -o"
        )
    check_outputs(json_file, inputs=[database], folder=output)
    facts = []
    for source in sources:
        for one in options:
            with progress_bar(f"{source.name}: ") as progress:
                made = [make_tracks(source, one, output, force, threads, progress)]
                if augmentations:
                    images = source.images
                    made.append(
                        make_augmented_tracks(
                            made[0], images, augmentations, force, threads, progress
                        )
                    )
            for file in made:
                facts.append(file.as_dict())
                _show(facts[-1], file.tracks.info)
    for path in maps:
        file = import_tracks(path, output)
        facts.append(file.as_dict())
        _show(facts[-1], file.tracks.info)
    write_json(json_file, facts)


# Poses that move by more than this share of the extent deserve a warning.
_FAR = 0.02


def _show(facts: dict[str, Any], info: dict[str, Any]) -> None:
    from protomark.cli.terminal import note, print_facts
    from protomark.report import first_of, track_rows

    if facts["skipped"]:
        note(f"{facts['file']}: up to date with these options, skipped (--force makes it anew)")
    rows = [
        ("tracks", facts["file"]),
        ("keypoints", f"{facts['keypoints']:,} in {facts['keyframes']} keyframes"),
        *track_rows(facts),
    ]
    if copies := facts.get("augmentations"):
        rows.append(("augmentations", f"{copies} copies of each keyframe"))
    if "epipolar_error" in info:
        fate = "kept as they are"
        if facts["poses_refined"]:
            share = info["pose_shift_max"] / info["extent"] if info["extent"] else 0.0
            fate = (
                f"refined by bundle adjustment, moved by {info['pose_shift_median']:.3g} (median), "
                f"{info['pose_shift_max']:.3g} (at most, {share:.1%} of the extent)"
            )
            if share > _FAR:
                note("warning: poses moved far; --refine-poses no keeps them as they are")
        rows.append(("given poses", f"epipolar error {info['epipolar_error']:.2f} pixels, {fate}"))
    if region := info.get("static_region"):
        note(f"left out, as it never moves while the rest does: {region}")
    if without := info.get("images_without_pose"):
        rows.append(("left out without a pose", first_of(without)))
    if unreadable := info.get("images_unreadable"):
        reasons = [f"{name} ({reason})" for name, reason in unreadable.items()]
        rows.append(("left out, cannot be read", first_of(reasons)))
    histogram = facts["track_length_histogram"]
    top = max(histogram.values(), default=0) or 1
    for label, count in histogram.items():
        if count:
            bar = "█" * max(1, round(_BAR * count / top))
            rows.append((f"{label} observations per landmark", f"{bar:<{_BAR}} {count}"))
    print_facts(rows)
