"""What `protomark tracks` does, and what it prints."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.markup import escape

from protomark.console import console, progress_bar, progress_console
from protomark.files import write_text
from protomark.tracks.extract import Progress, Settings, extract, find_source, fingerprint, is_done
from protomark.tracks.file import Tracks
from protomark.tracks.summary import summarise
from protomark.tracks.variants import METHOD, add_variants

_BAR = 30


def make_tracks(
    folders: list[Path],
    settings: list[Settings],
    output: Path,
    *,
    images: Path | None = None,
    model: Path | None = None,
    database: Path | None = None,
    variants: int = 0,
    force: bool = False,
    threads: int = 1,
    json_path: Path | None = None,
) -> list[dict[str, Any]]:
    """Make the tracks of each folder with each settings; write and print them.

    Returns:
        One summary for each file, see `protomark.tracks.summary.summarise`; that of a file with
        varied copies follows that of its plain one and has `variants`, their number.
    """
    if variants < 0:
        raise ValueError(f"--variants {variants}: give the number of copies, 0 for none")
    if variants and database:
        raise ValueError("--variants needs the images, and --database does not read them")
    if len(folders) > 1 and (images or model or database):
        raise ValueError("--images, --model and --database go with one FOLDER, give one at a time")
    names = [folder.resolve().name for folder in folders]
    double = sorted({n for n in names if names.count(n) > 1})
    if double:
        raise ValueError(
            f"two folders are named {double[0]} and would write the same file; run them apart, "
            "each with its own -o"
        )
    if output.exists() and not output.is_dir():
        raise NotADirectoryError(f"{output}: not a folder, name one for the tracks with -o")
    output.mkdir(parents=True, exist_ok=True)
    if json_path is not None and not json_path.absolute().parent.is_dir():
        raise FileNotFoundError(f"{json_path.parent}: no such folder for --json")
    summaries = []
    for folder in folders:
        for one in settings:
            target = output / f"{folder.resolve().name}.{one.descriptor}.safetensors"
            begin = time.perf_counter()
            if database:
                skipped, make = _from_database(folder, one, target, model, database, force)
            else:
                skipped, make = _from_images(folder, one, target, images, model, force, threads)
            if skipped:
                progress_console.print(
                    f"{target}: is there already, made with these settings; skipped "
                    "(--force makes it anew)",
                    markup=False,
                    highlight=False,
                    soft_wrap=True,
                )
                tracks = Tracks.load(target)
            else:
                tracks = _with_bar(folder.resolve().name, make)
                tracks.info["seconds"] = round(time.perf_counter() - begin, 1)
                tracks.save(target)
            summary = _summary(target, tracks, skipped)
            summaries.append(summary)
            print_summary(summary, tracks)
            if variants:
                folder_of_images = find_source(folder, images, model).images
                summaries.append(
                    _make_variants(tracks, folder_of_images, variants, target, force, threads)
                )
    if json_path is not None:
        write_text(json_path, json.dumps(summaries, indent=2) + "\n")
    return summaries


def _summary(path: Path, tracks: Tracks, skipped: bool) -> dict[str, Any]:
    seconds = tracks.info.get("seconds")
    return {"file": str(path), **summarise(tracks), "seconds": seconds, "skipped": skipped}


def variants_path(target: Path) -> Path:
    """Where the tracks with varied copies go: toy.freak.varied.safetensors."""
    return target.with_name(f"{target.stem}.varied.safetensors")


def _make_variants(
    tracks: Tracks, images: Path, count: int, target: Path, force: bool, threads: int
) -> dict[str, Any]:
    output = variants_path(target)
    want: dict[str, Any] = {"variants": count, "variants_method": METHOD}
    want |= {key: tracks.info.get(key) for key in ("method", "settings", "input")}
    if output.is_file() and not force:
        try:
            kept = Tracks.load(output)
        except (ValueError, OSError):
            kept = None
        if kept and all(kept.info.get(key) == value for key, value in want.items()):
            progress_console.print(
                f"{output}: is there already; skipped",
                markup=False,
                highlight=False,
                soft_wrap=True,
            )
            return {**_summary(output, kept, skipped=True), "variants": count}
    begin = time.perf_counter()
    total = len(tracks.keyframe_names)
    varied = _with_bar(
        target.name.split(".")[0],
        lambda progress: add_variants(
            tracks, images, count, threads, lambda done: progress("vary", done, total)
        ),
    )
    varied.info["seconds"] = round(time.perf_counter() - begin, 1)
    varied.save(output)
    added = len(varied.keypoints) - len(tracks.observations)
    console.print(
        f"[bold]{escape(str(output))}[/]\n  {count} varied copies of each keyframe, "
        f"{added} more observations",
        highlight=False,
        soft_wrap=True,
    )
    return {**_summary(output, varied, skipped=False), "variants": count}


def _from_images(
    folder: Path,
    settings: Settings,
    target: Path,
    images: Path | None,
    model: Path | None,
    force: bool,
    threads: int,
) -> tuple[bool, Callable[[Progress], Tracks]]:
    source = find_source(folder, images, model)
    done = not force and is_done(target, settings, fingerprint(source))
    return done, lambda progress: extract(source, settings, threads, progress)


def _from_database(
    folder: Path, settings: Settings, target: Path, model: Path | None, database: Path, force: bool
) -> tuple[bool, Callable[[Progress], Tracks]]:
    from protomark.tracks import database as source
    from protomark.tracks.colmap import find_model

    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder")
    where = model or find_model(folder)
    if not where.is_dir():
        raise FileNotFoundError(f"{where}: no such folder of a COLMAP model")
    name = settings.descriptor
    done = not force and source.is_done(target, name, source.digest_of(database, where))
    return done, lambda progress: source.from_database(database, where, name, folder.resolve().name)


def _with_bar(name: str, make: Callable[[Progress], Tracks]) -> Tracks:
    with progress_bar() as bar:
        tasks: dict[str, Any] = {}

        def progress(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                for other in tasks.values():
                    bar.update(other, visible=False)
                tasks[stage] = bar.add_task(f"{name}: {stage}", total=total)
            bar.update(tasks[stage], completed=done, total=total)

        return make(progress)


def print_summary(summary: dict[str, Any], tracks: Tracks) -> None:
    """Counts, error and the histogram of track lengths as a bar chart, on stdout."""
    info = tracks.info
    console.print(f"[bold]{escape(summary['file'])}[/]", highlight=False, soft_wrap=True)
    console.print(
        f"  {summary['keyframes']} keyframes, {summary['keypoints']} keypoints, "
        f"{summary['landmarks']} landmarks, {summary['observations']} observations "
        f"({summary['track_length_mean']:.1f} a landmark)",
        highlight=False,
        soft_wrap=True,
    )
    console.print(
        f"  reprojection error: mean {summary['reprojection_error_mean']:.2f} pixels, "
        f"median {summary['reprojection_error_median']:.2f}",
        highlight=False,
    )
    if "epipolar_error" in info:
        error, yes = info["epipolar_error"], summary["poses_refined"]
        console.print(
            f"  given poses: epipolar error {error:.2f} pixels, "
            + ("refined by bundle adjustment" if yes else "kept as they are"),
            highlight=False,
        )
        if error > 1 and not yes:
            progress_console.print(
                "  hint: these poses are only roughly right, --refine-poses auto would refine them",
                highlight=False,
            )
    without = info.get("images_without_pose") or []
    if without:
        console.print(
            f"  left out, as they have no pose: {', '.join(without[:3])}"
            + (f" and {len(without) - 3} more" if len(without) > 3 else ""),
            highlight=False,
            soft_wrap=True,
        )
    console.print("  observations of a landmark:", highlight=False)
    most = max(summary["track_length_histogram"].values(), default=0) or 1
    for label, count in summary["track_length_histogram"].items():
        if count:
            bar = "█" * max(1, round(_BAR * count / most))
            console.print(f"  {label:>7} {bar:<{_BAR}} {count}", highlight=False)
