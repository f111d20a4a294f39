"""What `protomark map` does, and what it prints."""

from __future__ import annotations

import contextlib
import json
import shutil
import signal
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.markup import escape

from protomark.console import console, progress_bar, progress_console
from protomark.files import write_text
from protomark.localization.cameras import read_cameras
from protomark.localization.poses import GivenPoses, read_poses
from protomark.mapping import outputs
from protomark.mapping.camera import guessed_camera
from protomark.mapping.mapper import Mapper, Picture
from protomark.mapping.settings import Settings
from protomark.mapping.source import Folder, Video, open_source
from protomark.mapping.state import CHECKPOINT, STATE, load_state, save_checkpoint, save_state
from protomark.mapping.summary import summarise

if TYPE_CHECKING:
    from protomark.mapping.view import View

REPORT, FIGURES, RECORDING = "report.html", "report.json", "recording.rrd"
# Seconds between checkpoints, which cost about a tenth of a second each.
_CHECKPOINT_EVERY = 20.0
_NAMES_SHOWN = 3


@dataclass(frozen=True)
class Request:
    """What is asked for.

    Attributes:
        images: folder of images or video.
        output: folder of the map.
        settings: how to make it; of a map that is gone on with, its own count.
        camera: cameras.txt, or MODEL:PARAMS; None: calibrate along the way.
        focal: focal length to begin with, pixels.
        poses: file or folder of given poses.
        every: take every n-th frame only.
        resume: go on with an interrupted map.
        extend: the output is a map that the images are added to.
        force: make a map anew where there is one.
        view: also write a Rerun recording.
        threads: threads to search and adjust on.
    """

    images: Path
    output: Path
    settings: Settings
    camera: str | None = None
    focal: float | None = None
    poses: Path | None = None
    every: int = 1
    resume: bool = False
    extend: bool = False
    force: bool = False
    view: bool = False
    threads: int = 1


class Interrupted(Exception):  # noqa: N818
    """Ctrl-C: what there is has been written."""


def make_map(request: Request) -> dict[str, Any]:
    """Make, go on with, or extend a map; write it and its report.

    Returns:
        Its figures, see `protomark.mapping.summary.summarise`.

    Raises:
        Interrupted: Ctrl-C was pressed; the map so far is written, and `resume` goes on with it.
        FileNotFoundError, FileExistsError, ValueError: what is asked for cannot be done.
    """
    if request.view:
        from protomark.mapping.view import find_rerun

        find_rerun()
    source = open_source(request.images, request.every)
    _check_output(request)
    poses = read_poses(request.poses) if request.poses else None
    mapper, cursor, prefix, inputs = _begin(request, source, poses)
    request.output.mkdir(parents=True, exist_ok=True)
    view = _view(request)
    facts = {"input": source.path.name, "prefix": prefix, "inputs": inputs}
    inputs[str(source.path.resolve())] = prefix
    mapper, stopped = _frames(request, mapper, source, poses, cursor, facts, view)
    if not stopped:
        _finish(mapper, source, prefix)
    if not mapper.structure.frames and not stopped:
        shutil.rmtree(request.output / CHECKPOINT, ignore_errors=True)
        raise ValueError(_no_map(mapper, source))
    figures = _write(request, mapper, source, facts, finished=not stopped)
    if view is not None:
        view.close()
    if stopped:
        raise Interrupted
    return figures


def _check_output(request: Request) -> None:
    scene = request.output
    if scene.exists() and not scene.is_dir():
        raise NotADirectoryError(f"{scene}: not a folder, name one for the map with -o")
    interrupted = (scene / CHECKPOINT).is_dir()
    if request.resume:
        if not interrupted:
            raise FileNotFoundError(f"{scene}: no interrupted map here to resume")
        return
    if request.extend:
        if interrupted:
            raise FileExistsError(
                f"{scene}: this map was interrupted, finish it first with --resume"
            )
        return
    if request.force or not scene.exists() or not any(scene.iterdir()):
        return
    if interrupted:
        raise FileExistsError(
            f"{scene}: an interrupted map is there: --resume goes on with it, --force starts anew"
        )
    if (scene / STATE).exists():
        raise FileExistsError(
            f"{scene}: a map is there already: --into {scene} extends it, --force makes it anew"
        )
    raise FileExistsError(f"{scene}: not empty, and no map; name another folder with -o")


def _begin(
    request: Request, source: Folder | Video, poses: GivenPoses | None
) -> tuple[Mapper, int, str, dict[str, str]]:
    """The mapper, the place to go on at, what comes before names, and of earlier inputs' names."""
    scene = request.output
    size = source.size()
    camera = None
    if request.camera:
        camera = read_cameras(request.camera).find("", *size)
    elif request.poses is not None and request.poses.is_dir():
        camera = read_cameras(str(request.poses)).find("", *size)
    if request.resume:
        mapper, facts = load_state(scene / CHECKPOINT, request.threads)
        if facts.get("input") != source.path.name:
            raise ValueError(
                f"{scene}: the interrupted map was of {facts.get('input')}, "
                f"not of {source.path.name}"
            )
        return mapper, int(facts["cursor"]), str(facts["prefix"]), facts["inputs"]
    if request.extend:
        mapper, facts = load_state(scene, request.threads, camera)
        return mapper, 0, _prefix(mapper, source, facts), facts["inputs"]
    settings = request.settings
    if poses is not None:
        settings = replace(settings, fixed_poses=True)
    if camera is None:
        if poses is not None:
            raise ValueError("--poses needs the camera that they are for, give it with --camera")
        camera, origin = guessed_camera(source, request.focal)
        settings = replace(settings, calibrate=True)
        progress_console.print(
            f"camera: focal length {camera.params[0]:.0f} pixels is {origin}, it is refined along "
            "the way (--camera gives a known one)",
            highlight=False,
            soft_wrap=True,
        )
    if request.force:
        shutil.rmtree(scene / CHECKPOINT, ignore_errors=True)
    return Mapper(settings, camera, request.threads), 0, "", {}


def _prefix(mapper: Mapper, source: Folder | Video, facts: dict[str, Any]) -> str:
    """What comes before the names of new frames, so that they are no names of old ones.

    A folder that the map was made from before may have grown: its old images are passed over.

    Raises:
        ValueError: no frame is new.
    """
    inputs: dict[str, str] = facts.get("inputs", {})
    here = str(source.path.resolve())
    known = mapper.history.entries
    if here in inputs:
        prefix = inputs[here]
        names = source.names if isinstance(source, Folder) else [p.name for p in source.pictures()]
        if all(prefix + name in known for name in names):
            raise ValueError(f"{source.path}: all its {len(names)} frames are in this map already")
        return prefix
    names = [source.path.name, *(f"{source.path.name}-{i}" for i in range(2, 1000))]
    return next(f"{n}/" for n in names if not any(k.startswith(f"{n}/") for k in known))


def _view(request: Request) -> View | None:
    if not request.view:
        return None
    from protomark.mapping.view import View

    return View(request.output / RECORDING)


def _pictures(
    source: Folder | Video, prefix: str, poses: GivenPoses | None, pictures: Iterable[Picture]
) -> Iterator[Picture]:
    for picture in pictures:
        pose = poses.of(picture.name, picture.time) if poses else None
        yield replace(picture, name=prefix + picture.name, pose=pose)


def _frames(
    request: Request,
    mapper: Mapper,
    source: Folder | Video,
    poses: GivenPoses | None,
    cursor: int,
    facts: dict[str, Any],
    view: View | None,
) -> tuple[Mapper, bool]:
    """Put frame after frame into the map; the map, and whether Ctrl-C stopped it."""
    saved = time.monotonic()
    started, first = time.monotonic(), cursor
    with progress_bar() as bar, _stop_on_interrupt() as stop:
        task = bar.add_task("map", total=len(source), completed=cursor)
        pictures = _pictures(source, facts["prefix"], poses, source.pictures(cursor))
        while True:
            picture = next(pictures, None)
            if mapper.misjudged(ended=picture is None):
                # What was made with the guess is bent: from the first frame on with what it told.
                mapper, cursor, first, started = mapper.begin_again(), 0, 0, time.monotonic()
                progress_console.print(mapper.history.events[-1], highlight=False, soft_wrap=True)
                pictures = _pictures(source, facts["prefix"], poses, source.pictures())
                continue
            if picture is None:
                break
            if picture.name not in mapper.history.entries:
                mapper.add(picture)
            cursor = picture.index + 1
            if view is not None:
                view.show(mapper, picture)
            rate = (cursor - first) / max(time.monotonic() - started, 1e-9)
            found = len(mapper.structure.frames)
            bar.update(
                task,
                completed=cursor,
                total=max(len(source), cursor),
                description=f"map: {found} registered, {rate:.1f} frames/s",
            )
            if stop or time.monotonic() - saved > _CHECKPOINT_EVERY:
                save_checkpoint(mapper, request.output, {**facts, "cursor": cursor})
                saved = time.monotonic()
            if stop:
                return mapper, True
    mapper.guess = 0.0
    save_checkpoint(mapper, request.output, {**facts, "cursor": cursor})
    return mapper, False


@contextlib.contextmanager
def _stop_on_interrupt() -> Iterator[list[bool]]:
    """A list that is not empty any more when Ctrl-C was pressed; a second one ends at once."""
    pressed: list[bool] = []

    def stop(number: int, frame: Any) -> None:
        if pressed:
            raise KeyboardInterrupt
        pressed.append(True)

    try:
        before = signal.signal(signal.SIGINT, stop)
    except ValueError:  # not the main thread: Ctrl-C is someone else's
        yield pressed
        return
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, before)


def _finish(mapper: Mapper, source: Folder | Video, prefix: str) -> None:
    with progress_bar() as bar:
        task = bar.add_task("look again, adjust", total=None)

        def again(names: set[str], backward: bool) -> Iterator[Picture]:
            wanted = {name.removeprefix(prefix) for name in names if name.startswith(prefix)}
            pictures = source.pictures(only=wanted, backward=backward)
            return _pictures(source, prefix, None, pictures)

        mapper.finish(again, lambda done, total: bar.update(task, completed=done, total=total))


def _no_map(mapper: Mapper, source: Folder | Video) -> str:
    entries = mapper.history.entries.values()
    outcomes = {e.outcome for e in entries}
    if len(outcomes) == 1 and not any(e.keypoints for e in entries):
        return f"{source.path}: no map: none of {len(entries)} frames is usable: {outcomes.pop()}"
    parallax = mapper.initialiser.best_parallax
    return (
        f"{source.path}: no map: among {len(entries)} frames no two see enough of the same from "
        f"places far enough apart (the best pair has {parallax:.1f} degrees of parallax, 2 are "
        "needed); move the camera sideways, or check that frames overlap and --camera is right"
    )


def _write(
    request: Request, mapper: Mapper, source: Folder | Video, facts: dict[str, Any], finished: bool
) -> dict[str, Any]:
    from protomark.mapping.report import write_report

    scene = request.output
    figures = {"input": source.path.name, "finished": finished, **summarise(mapper)}
    outputs.write_map(mapper.structure, mapper.memory, scene / outputs.MAP)
    outputs.write_model(mapper.structure, scene / outputs.MODEL)
    outputs.write_trajectory(mapper.structure, scene / outputs.TRAJECTORY)
    write_report(mapper, figures, f"Map of {source.path.name}", scene / REPORT)
    frames = [vars(entry) for entry in mapper.history.entries.values()]
    write_text(scene / FIGURES, json.dumps({**figures, "history": frames}, indent=1) + "\n")
    if finished:
        save_state(mapper, scene / STATE, facts)
        shutil.rmtree(scene / CHECKPOINT, ignore_errors=True)
    return figures


def show(figures: dict[str, Any], scene: Path) -> None:
    """Print what came out."""
    ratio = figures["descriptor_bytes"] / max(figures["memory_bytes"], 1)
    say(f"[bold]{escape(str(scene))}[/]")
    say(
        f"  {figures['registered']} of {figures['frames']} frames registered, "
        f"{figures['keyframes']} keyframes, {figures['landmarks']} landmarks, "
        f"{figures['observations']} observations ({figures['track_length_mean']:.1f} a landmark)"
    )
    say(
        f"  reprojection error: mean {figures['reprojection_error_mean']:.2f} pixels, "
        f"median {figures['reprojection_error_median']:.2f}"
    )
    say(
        f"  memory for matching ({figures['memory']}): {figures['memory_bytes'] / 1e6:.2f} MB, "
        f"{figures['bytes_per_landmark']:.0f} bytes a landmark; all descriptors: "
        f"{figures['descriptor_bytes'] / 1e6:.2f} MB, {ratio:.1f} times as much"
    )
    say(
        f"  {figures['seconds_total']:.1f} s, {figures['frames_per_second']:.1f} frames a second; "
        f"{scene / REPORT} tells more"
    )
    for reason, names in figures["not_registered"].items():
        some = ", ".join(names[:_NAMES_SHOWN])
        more = f" and {len(names) - _NAMES_SHOWN} more" if len(names) > _NAMES_SHOWN else ""
        say(f"  [yellow]without a pose[/]: {escape(some)}{more}: {escape(reason)}")


def say(text: str) -> None:
    """One line on stdout."""
    console.print(text, highlight=False, soft_wrap=True)


def explain_interruption(scene: Path) -> None:
    """Say on stderr how to go on."""
    progress_console.print(
        f"stopped: the map so far is in {scene}; the same command with --resume goes on",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
