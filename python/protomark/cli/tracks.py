"""The command `protomark tracks`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from protomark.cli.options import JsonFile, MaxKeypoints, Threads

if TYPE_CHECKING:
    from protomark.tracks.make import TracksInput

_BAR = 30  # characters


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
            help="COLMAP database with binary descriptors: its descriptors and the model's points "
            "become the tracks, and images are not read.",
        ),
    ] = None,
    max_keypoints: MaxKeypoints = 2000,
    partners: Annotated[
        int, typer.Option(help="About how many keyframes each keyframe is matched with.")
    ] = 24,
    ratio: Annotated[
        float,
        typer.Option(help="Ratio test: a match is nearer than this share of the second nearest."),
    ] = 0.8,
    max_error: Annotated[
        float, typer.Option(help="Largest epipolar and reprojection error, pixels.")
    ] = 3.0,
    min_angle: Annotated[
        float, typer.Option(help="Smallest triangulation angle of a landmark, degrees.")
    ] = 1.0,
    min_length: Annotated[
        int, typer.Option(help="Leave out landmarks with fewer observations.")
    ] = 3,
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
    force: Annotated[
        bool, typer.Option("--force", help="Make files anew even if they are up to date.")
    ] = False,
    json_file: JsonFile = None,
) -> None:
    """Make tracks from images with known poses.

    Reads images and their COLMAP model. Writes one file per sequence and descriptor with keypoints,
    descriptors, and the landmarks that they observe. A file that was made with these options from
    this input is kept.

    protomark tracks kitchen/ -o tracks -d freak -d orb
    """
    from protomark.cli.terminal import check_outputs, note, progress_bar, write_json
    from protomark.threads import available_threads
    from protomark.tracks.extract import TracksOptions
    from protomark.tracks.make import TracksInput, make_augmented_tracks, make_tracks

    options = [
        TracksOptions(
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
    sources = [TracksInput(folder, images, model, database) for folder in folders]
    _check(sources, output, augmentations)
    check_outputs(json_file, inputs=[database])
    threads = threads or available_threads()
    facts = []
    for source in sources:
        for one in options:
            with progress_bar(f"{source.name}: ") as progress:
                made = make_tracks(
                    source, one, output, force=force, threads=threads, progress=progress
                )
            if made.skipped:
                note(f"{made.path}: up to date with these options, skipped (--force makes it anew)")
            facts.append(made.as_dict())
            _show(facts[-1], made.tracks.info)
            if not augmentations:
                continue
            folder = images or source.folder / "images"
            with progress_bar(f"{source.name}: ") as progress:
                more = make_augmented_tracks(
                    made, folder, augmentations, force=force, threads=threads, progress=progress
                )
            facts.append(more.as_dict())
            _show_augmented(facts[-1], facts[-2])
    write_json(json_file, facts)


def _check(sources: list[TracksInput], output: Path, augmentations: int) -> None:
    """Raise before any work if options conflict."""
    first = sources[0]
    if augmentations < 0:
        raise ValueError(f"--augmentations {augmentations}: give a number of copies, 0 for none")
    if augmentations and first.database:
        raise ValueError("--augmentations needs images, which --database does not read: drop one")
    if len(sources) > 1 and (first.images or first.model or first.database):
        raise ValueError("--images, --model and --database are for one FOLDER: give only one")
    names = [source.name for source in sources]
    double = sorted({n for n in names if names.count(n) > 1})
    if double:
        raise ValueError(
            f"two folders are named {double[0]} and would write the same file: run the command for "
            "each, with its own -o"
        )
    if output.exists() and not output.is_dir():
        raise NotADirectoryError(f"{output} is not a folder: name one for the tracks with -o")


# Poses that move by more than this share of the extent deserve a warning.
_FAR = 0.02


def _show(facts: dict[str, Any], info: dict[str, Any]) -> None:
    from rich.markup import escape

    from protomark.cli.terminal import note, say

    say(f"[bold]{escape(facts['file'])}[/]")
    say(
        f"  {facts['keyframes']} keyframes, {facts['keypoints']} keypoints, "
        f"{facts['landmarks']} landmarks, {facts['observations']} observations "
        f"({facts['track_length_mean']:.1f} per landmark)"
    )
    say(
        f"  reprojection error: mean {facts['reprojection_error_mean']:.2f} pixels, "
        f"median {facts['reprojection_error_median']:.2f}"
    )
    if "epipolar_error" in info:
        fate = "kept as they are"
        if facts["poses_refined"]:
            share = info["pose_shift_max"] / info["extent"] if info["extent"] else 0.0
            fate = (
                f"refined by bundle adjustment, moved by {info['pose_shift_median']:.3g} (median), "
                f"{info['pose_shift_max']:.3g} (at most, {share:.1%} of the extent)"
            )
            if share > _FAR:
                note("  warning: poses moved far; --refine-poses no keeps them as they are")
        say(f"  given poses: epipolar error {info['epipolar_error']:.2f} pixels, {fate}")
    if info.get("static_region"):
        box = ", ".join(map(str, info["static_region"]))
        note(
            f"  left out: what never moves while the rest does, within left, top, right, bottom = "
            f"{box} pixels (an overlay, the camera's own vehicle?)"
        )
    without = info.get("images_without_pose") or []
    if without:
        more = f" and {len(without) - 3} more" if len(without) > 3 else ""
        say(f"  left out without a pose: {escape(', '.join(without[:3]))}{more}")
    say("  observations per landmark:")
    top = max(facts["track_length_histogram"].values(), default=0) or 1
    for label, count in facts["track_length_histogram"].items():
        if count:
            bar = "█" * max(1, round(_BAR * count / top))
            say(f"  {label:>7} {bar:<{_BAR}} {count}")


def _show_augmented(facts: dict[str, Any], plain: dict[str, Any]) -> None:
    from rich.markup import escape

    from protomark.cli.terminal import say

    added = facts["observations"] - plain["observations"]
    say(f"[bold]{escape(facts['file'])}[/]")
    say(f"  {facts['augmentations']} copies of each keyframe, {added} more observations")
