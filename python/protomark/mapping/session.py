"""Makes, resumes or extends a map from a source of frames."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from protomark.geometry.camera_files import read_cameras
from protomark.geometry.pose_files import read_poses
from protomark.interrupt import Interrupted, deferred_interrupt
from protomark.mapping.initialisation import MIN_PARALLAX
from protomark.mapping.mapper import Mapper
from protomark.mapping.options import MappingOptions
from protomark.mapping.outputs import write_outputs
from protomark.mapping.recording import Recording
from protomark.mapping.source import FrameSource, open_source
from protomark.mapping.state import CHECKPOINT, STATE, load_state, save_checkpoint, save_state
from protomark.progress import Progress, silent

RECORDING = "recording.rrd"
# Seconds between checkpoints, each of which takes about a tenth of a second.
_CHECKPOINT_INTERVAL = 20.0


@dataclass(frozen=True)
class MapRequest:
    """What to map, and how.

    Attributes:
        images: folder of images or video.
        output: folder of the map.
        options: how to make it; a map that is resumed or extended keeps its own.
        camera: cameras.txt, a COLMAP model, or a camera written out; None: calibrate while mapping.
        focal: focal length to start calibration with, pixels.
        poses: file or folder of known poses.
        every: take every n-th frame only.
        resume: whether to continue an interrupted map.
        extend: whether to add the images to the existing map in `output`.
        force: whether to replace an existing map.
        record: whether to write a Rerun recording, too.
        seal: whether to write a sealed map, too.
        threads: threads to search and adjust on.
    """

    images: Path
    output: Path
    options: MappingOptions
    camera: str | None = None
    focal: float | None = None
    poses: Path | None = None
    every: int = 1
    resume: bool = False
    extend: bool = False
    force: bool = False
    record: bool = False
    seal: bool = True
    threads: int = 1


def make_map(
    request: MapRequest,
    progress: Progress = silent,
    note: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Make, resume or extend a map; write it and its report.

    Args:
        request: what to map, and how.
        progress: called with each frame.
        note: called with each message to the user.

    Returns:
        Its figures, see `protomark.mapping.summary.summarise`.

    Raises:
        Interrupted: Ctrl-C was pressed; the map so far is written.
        FileNotFoundError, FileExistsError, ValueError: the request cannot be met.
    """
    source = open_source(request.images, request.every)
    _check_output(request)
    session = _Session(request, source, progress, note)
    finished = session.add_frames()
    mapper = session.mapper
    if finished:
        mapper.finish(
            lambda names, backward: source.images(only=names, backward=backward), progress
        )
        if not mapper.structure.frames:
            shutil.rmtree(request.output / CHECKPOINT, ignore_errors=True)
            raise ValueError(_no_map(mapper, source))
    progress("write", 0, 0)
    figures = write_outputs(mapper, request.output, source.path.name, finished, request.seal)
    if session.recording is not None:
        session.recording.close()
    if not finished:
        raise Interrupted(
            f"stopped: the map so far is in {request.output}; the same command with --resume "
            "continues it"
        )
    save_state(mapper, request.output / STATE, session.facts)
    shutil.rmtree(request.output / CHECKPOINT, ignore_errors=True)
    return figures


class _Session:
    """One run over the frames of a source.

    Attributes:
        mapper: the map in the making.
        cursor: index of the next frame.
        facts: the inputs so far with the prefixes of their frames' names, to continue the map.
    """

    def __init__(
        self,
        request: MapRequest,
        source: FrameSource,
        progress: Progress,
        note: Callable[[str], None],
    ) -> None:
        self.request, self.source = request, source
        self.progress, self.note = progress, note
        self.cursor = 0
        if request.poses:
            source.poses = read_poses(request.poses).for_images(source.names())
        if request.resume:
            self._resume()
        elif request.extend:
            self._extend()
        else:
            self._start()
        request.output.mkdir(parents=True, exist_ok=True)
        self.recording = Recording(request.output / RECORDING) if request.record else None

    def _camera(self) -> Any:
        request = self.request
        if request.camera:
            return read_cameras(request.camera).find("", *self.source.size())
        if request.poses is not None and request.poses.is_dir():
            return read_cameras(str(request.poses)).find("", *self.source.size())
        return None

    def _start(self) -> None:
        request, options = self.request, self.request.options
        camera = self._camera()
        if self.source.poses is not None:
            options = replace(options, fixed_poses=True)
            if camera is None:
                raise ValueError("--poses needs the camera of the images: give it with --camera")
        if camera is None:
            camera, origin = self.source.guess_camera(request.focal)
            options = replace(options, calibrate=True)
            self.note(
                f"camera: the focal length of {camera.params[0]:.0f} pixels is {origin} and is "
                "refined while mapping (--camera gives a calibrated one)"
            )
        if request.force:
            shutil.rmtree(request.output / CHECKPOINT, ignore_errors=True)
        self.mapper = Mapper(options, camera, request.threads)
        self._set_input("", {})

    def _resume(self) -> None:
        scene = self.request.output
        self.mapper, facts = load_state(scene / CHECKPOINT, self.request.threads)
        if facts.get("input") != self.source.path.name:
            raise ValueError(
                f"{scene}: the interrupted map was of {facts.get('input')}, "
                f"not of {self.source.path.name}"
            )
        self.cursor = int(facts["cursor"])
        self._set_input(str(facts["prefix"]), facts["inputs"])

    def _extend(self) -> None:
        self.mapper, facts = load_state(self.request.output, self.request.threads, self._camera())
        inputs: dict[str, str] = facts.get("inputs", {})
        self._set_input(_prefix(self.mapper, self.source, inputs), inputs)

    def _set_input(self, prefix: str, inputs: dict[str, str]) -> None:
        source = self.source
        source.prefix = prefix
        inputs = {**inputs, str(source.path.resolve()): prefix}
        self.facts: dict[str, Any] = {
            "input": source.path.name,
            "prefix": prefix,
            "inputs": inputs,
        }

    def add_frames(self) -> bool:
        """Add all frames to the map; returns False if Ctrl-C stopped that."""
        saved = started = time.monotonic()
        first = self.cursor
        with deferred_interrupt(lambda: self.note("stopping after this frame")) as interrupted:
            images = self.source.images(self.cursor)
            while True:
                image = next(images, None)
                if self.mapper.needs_restart(at_end=image is None):
                    # The wrong focal length has bent the first part of the map.
                    self.mapper = self.mapper.restart()
                    self.note(self.mapper.history.events[-1])
                    self.cursor, first, started = 0, 0, time.monotonic()
                    images = self.source.images()
                    continue
                if image is None:
                    break
                if image.name not in self.mapper.history.records:
                    self.mapper.add(image)
                self.cursor = image.index + 1
                if self.recording is not None:
                    self.recording.show(self.mapper, image)
                rate = (self.cursor - first) / max(time.monotonic() - started, 1e-9)
                registered = len(self.mapper.structure.frames)
                stage = f"map, {registered} registered, {rate:.1f} frames/s"
                self.progress(stage, self.cursor, max(len(self.source), self.cursor))
                if interrupted() or time.monotonic() - saved > _CHECKPOINT_INTERVAL:
                    self._save()
                    saved = time.monotonic()
                if interrupted():
                    return False
        self.mapper.guessed_focal = 0.0
        self._save()
        return True

    def _save(self) -> None:
        save_checkpoint(self.mapper, self.request.output, {**self.facts, "cursor": self.cursor})


def _check_output(request: MapRequest) -> None:
    """Raise before any work if the output folder is not what the request needs."""
    scene = request.output
    if scene.exists() and not scene.is_dir():
        raise NotADirectoryError(f"{scene} is not a folder: name one for the map with -o")
    interrupted = (scene / CHECKPOINT).is_dir()
    if request.resume:
        if not interrupted:
            raise FileNotFoundError(
                f"{scene} holds no interrupted map: start a new one without --resume"
            )
        return
    if request.extend:
        if interrupted:
            raise FileExistsError(
                f"{scene} holds an interrupted map: finish it with --resume first"
            )
        return
    if request.force or not scene.exists() or not any(scene.iterdir()):
        return
    if interrupted:
        raise FileExistsError(
            f"{scene} holds an interrupted map: --resume continues it, --force starts anew"
        )
    if (scene / STATE).exists():
        raise FileExistsError(
            f"{scene} holds a map already: --into {scene} extends it, --force makes it anew"
        )
    raise FileExistsError(f"{scene} holds other files: name another folder with -o")


def _prefix(mapper: Mapper, source: FrameSource, inputs: dict[str, str]) -> str:
    """A prefix for the names of new frames that makes them differ from the old ones.

    A folder that the map was made from may have new images: it keeps its prefix, and its old images
    are skipped.

    Raises:
        ValueError: no frame is new.
    """
    records = mapper.history.records
    here = str(source.path.resolve())
    if here in inputs:
        names = source.names()
        if all(inputs[here] + name in records for name in names):
            raise ValueError(f"{source.path}: all its {len(names)} frames are in this map already")
        return inputs[here]
    names = [source.path.name, *(f"{source.path.name}-{i}" for i in range(2, 1000))]
    return next(f"{n}/" for n in names if not any(r.startswith(f"{n}/") for r in records))


def _no_map(mapper: Mapper, source: FrameSource) -> str:
    records = mapper.history.records.values()
    outcomes = {record.outcome for record in records}
    if len(outcomes) == 1 and not any(record.keypoints for record in records):
        return f"{source.path}: no map: none of {len(records)} frames is usable: {outcomes.pop()}"
    parallax = mapper.initialiser.best_parallax
    return (
        f"{source.path}: no map: no two of {len(records)} frames overlap enough and are taken far "
        f"enough apart (the best pair has {parallax:.1f} degrees of parallax, {MIN_PARALLAX:g} are "
        "needed): move the camera sideways, or check that frames overlap and --camera is right"
    )
