"""Makes, resumes or extends a map from a source of frames."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from typing import Any

from protomark.features.extractor import Features, pixel_size
from protomark.features.static_regions import describe, read_mask, static_regions
from protomark.files import STATE, only_writer
from protomark.geometry.camera import Camera
from protomark.geometry.camera_files import read_cameras
from protomark.geometry.given_poses import misfit
from protomark.interrupt import Interrupted, deferred_interrupt
from protomark.mapping import starts
from protomark.mapping.frame import InputImage
from protomark.mapping.mapper import Mapper
from protomark.mapping.merging_maps import insert_map
from protomark.mapping.options import MappingOptions
from protomark.mapping.ordering import matching_order
from protomark.mapping.outputs import back_up, write_outputs
from protomark.mapping.recording import Recording
from protomark.mapping.request import (
    MapRequest,
    check_output,
    check_same_options,
    check_same_request,
    request_facts,
    same_camera,
)
from protomark.mapping.self_calibration import MAX_RESTARTS, elect_focal_length
from protomark.mapping.source import EXIF, GIVEN, GUESS, FrameSource, ImageFolder, open_source
from protomark.mapping.state import CHECKPOINT, load_state, save_checkpoint, save_state
from protomark.mapping.survey import Survey, survey
from protomark.mapping.trust import are_elsewhere, no_map
from protomark.maps.alignment import align_maps
from protomark.progress import Progress, silent, tracked
from protomark.threads import one_blas_thread, read_ahead

RECORDING = "recording.rrd"
# Seconds between checkpoints, each of which takes about a tenth of a second.
_CHECKPOINT_INTERVAL = 20.0
# For so few, another order is looked for even if most match the next one.
_FEW_PHOTOS = 60
# A session is mapped apart if none of its first so many frames that moved is found in the map.
_LOOKED_FOR = 5


def make_map(
    request: MapRequest,
    progress: Progress = silent,
    note: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Make, resume or extend a map; write it and its report; returns its figures.

    Raises:
        Interrupted: Ctrl-C was pressed; the map so far is written.
        FileNotFoundError, FileExistsError, ValueError: the request cannot be met.
    """
    source = open_source(request.images, request.every, request.topic)
    # More threads of BLAS would change the order of sums.
    with only_writer(request.output), one_blas_thread():
        check_output(request)
        return _make_map(request, source, progress, note)


def _make_map(
    request: MapRequest, source: FrameSource, progress: Progress, note: Callable[[str], None]
) -> dict[str, Any]:
    session = _Session(request, source, progress, note)
    checkpoint = request.output / CHECKPOINT
    resume = "the same command with --resume continues it"
    while finished := session.add_frames():
        try:
            if session.finish():
                break
        except KeyboardInterrupt:
            raise Interrupted(f"stopped before the last adjustment of the map: {resume}") from None
    mapper, known = session.mapper, session.known
    if session.apart and not finished:
        raise Interrupted(f"stopped: {request.output} is still as it was; {resume}")
    if finished:
        elsewhere = known > 0 and are_elsewhere(mapper, source)
        if not len(mapper.structure.ids) or len(mapper.structure.frames) <= known or elsewhere:
            shutil.rmtree(checkpoint, ignore_errors=True)
            raise ValueError(no_map(mapper, source, known))
    progress("write", 0, 0)
    if request.extend:
        back_up(request.output)
    figures = write_outputs(mapper, request.output, source.path.name, finished, request.seal)
    if session.recording is not None:
        session.recording.close()
    if not finished:
        raise Interrupted(f"stopped: the map so far is in {request.output}; {resume}")
    save_state(mapper, request.output / STATE, session.facts)
    shutil.rmtree(checkpoint, ignore_errors=True)
    return figures


class _Session:
    """One run over the frames of a source.

    Attributes:
        mapper: the map in the making.
        cursor: number of frames that are done.
        facts: what a later run needs to continue the map: the request, and the inputs so far with
            the prefixes of their frames' names.
        known: number of frames that the map had before this run.
        apart: whether the frames are mapped on their own, to merge their map with the one in the
            output at the end.
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
        self.cursor = self.known = 0
        self.apart = False
        self._order: list[str] = []  # names of photos that had none
        self._left_out: list[str] = []  # names of images that the map has of other folders
        self.facts: dict[str, Any] = {}
        if request.resume:
            self._resume()
        elif request.extend:
            self._extend()
        else:
            self._start()
        self.recording = Recording(request.output / RECORDING) if request.record else None

    def _camera(self) -> Camera | None:
        request = self.request
        text = request.camera
        if text is None and request.poses is not None and request.poses.is_dir():
            text = str(request.poses)
        if text and request.focal is not None:
            raise ValueError("--focal begins a calibration, but the camera is given: leave it out")
        if text:
            return self.source.find_camera(read_cameras(text))
        known = self.source.known_camera() if request.focal is None else None
        if known is not None:
            self.note(f"camera: that of {request.images.name}, {known}")
        return known

    def _read_poses(self) -> None:
        if self.request.poses:
            self.source.poses = self.source.read_poses(self.request.poses)

    def _start(self) -> None:
        request, options = self.request, self.request.options
        self._read_poses()
        camera = self._camera()
        if self.source.poses is not None:
            options = replace(options, fixed_poses=True)
            if camera is None:
                raise ValueError("--poses needs the camera of the images: give it with --camera")
        surveyed = self._in_order(options, self._survey(options))
        origin = ""
        if camera is None:
            camera, origin = self._guess_camera(surveyed)
            options = replace(options, calibrate=True)
            self.note(
                f"camera: the focal length of {camera.params[0]:.0f} pixels is {origin} and is "
                "refined while mapping (--camera gives a calibrated one)"
            )
        else:
            self._check_poses(surveyed, camera, options)
        if request.force:
            shutil.rmtree(request.output / CHECKPOINT, ignore_errors=True)
        self._set_mapper(options, camera, origin)
        self._prepare(surveyed, "", {})

    def _set_mapper(self, options: MappingOptions, camera: Camera, origin: str) -> None:
        """Start an empty map with a camera; `origin` says where its focal length comes from."""
        self.mapper = Mapper(options, camera, self.request.threads)
        if self.mapper.calibration is not None:
            self.mapper.calibration.given = origin in (GIVEN, EXIF)
            self.mapper.calibration.guessed = origin == GUESS

    def _check_poses(self, surveyed: Survey, camera: Camera, options: MappingOptions) -> None:
        pixel = pixel_size((camera.width, camera.height), options.max_size)
        if sentence := misfit(surveyed.pose_errors(camera, pixel)):
            raise ValueError(f"{self.request.poses}: {sentence}")

    def _guess_camera(self, surveyed: Survey) -> tuple[Camera, str]:
        """A camera to start calibration with, and the origin of its focal length."""
        camera, origin = self.source.guess_camera(self.request.focal)
        if origin in (GIVEN, EXIF):
            return camera, origin
        focal = elect_focal_length(surveyed.pairs, (camera.width, camera.height))
        if focal is None:
            return camera, origin
        return replace(camera, params=(focal, *camera.params[1:])), "what the first frames agree on"

    def _resume(self) -> None:
        folder = self.request.output / CHECKPOINT
        self.mapper, facts = load_state(folder, self.request.threads)
        self._leave_out(facts["left_out"])
        self._order = facts["order"]
        check_same_request(
            self.request.output, request_facts(self.request, self.source), facts["request"]
        )
        if isinstance(self.source, ImageFolder) and self._order:
            self.source.reorder(self._order)
        self._read_poses()
        self._camera()  # for the source to know those of its images
        self.cursor, self.known = int(facts["cursor"]), int(facts["known"])
        self.apart = bool(facts["apart"])
        self._prepare(self._survey(self.mapper.options), str(facts["prefix"]), facts["inputs"])
        self.source.shift(*facts["shift"])

    def _extend(self, by_frame: bool = False) -> None:
        """Add the frames to a map, or map them apart if it shows none of the first."""
        request = self.request
        self.mapper, facts = load_state(request.output, request.threads)
        self.mapper.history.begin_run()
        check_same_options(request, self.mapper.options)
        camera = self._camera()
        if camera is not None and not self.source.cameras:
            given = camera
            camera = same_camera(request, self.mapper.structure.cameras.values(), given)
            if camera != given:
                self.note(
                    f"camera: that of {request.output.name}, {camera}, which {given} resembles"
                )
        self.mapper.camera_id = self.mapper.id_of_camera(camera)
        self._read_poses()
        inputs: dict[str, str] = facts.get("inputs", {})
        if isinstance(self.source, ImageFolder):
            self._leave_out(self.source.known_images(inputs, self.mapper.history.records))
        prefix = _prefix(self.mapper, self.source, inputs)
        self.known, self.cursor = len(self.mapper.structure.frames), 0
        surveyed = self._survey(self.mapper.options)
        self._check_poses(surveyed, self.mapper.camera, self.mapper.options)
        self._prepare(surveyed, prefix, inputs)
        again = str(self.source.path.resolve()) in inputs
        self.apart = not (by_frame or again or self.source.poses or self._is_found())
        if self.apart:
            self._start_apart(surveyed, prefix, inputs)
            return
        self.source.follow(self.mapper.structure, self.mapper.history.records)
        if shift := self.source.time_shift:
            told = (
                f"the map has frames of these times: those of {self.source.path.name} are shifted"
            )
            self.mapper.history.events.append(f"{told} by {shift:g}")
            self.note(self.mapper.history.events[-1])

    def _leave_out(self, names: list[str]) -> None:
        """Leave out images that the map has of other folders."""
        source = self.source
        if not names or not isinstance(source, ImageFolder):
            return
        known = set(names)
        new = [name for name in source.names() if name not in known]
        if not new:
            raise ValueError(f"{source.path}: all its {len(names)} frames are in this map already")
        source.reorder(new)
        self._left_out += names
        self.note(f"{len(names)} images of {source.path.name} are in the map already")

    def _is_found(self) -> bool:
        """Whether the map shows one of the first frames."""
        self.progress("look for the first frames in the map", 0, 0)
        names = set(islice(self.mapper.features, _LOOKED_FOR))
        return any(map(self.mapper.shows, islice(self.source.images(only=names), len(names))))

    def _start_apart(self, surveyed: Survey, prefix: str, inputs: dict[str, str]) -> None:
        """Start a map of the frames alone, with the options of the map and, if it fits, camera."""
        name, base = self.request.output.name, self.mapper
        self.note(f"{name} shows none of the first frames: they are mapped apart, to be merged")
        options, camera = base.options, base.camera
        surveyed = self._in_order(options, surveyed)
        origin = ""
        if (camera.width, camera.height) != self.source.size():
            camera, origin = self._guess_camera(surveyed)
            options = replace(options, calibrate=True)
        self.known = 0
        self._set_mapper(options, camera, origin)
        self._prepare(surveyed, prefix, inputs)

    def finish(self) -> bool:
        """Adjust the whole map; False if it cannot be merged: its frames are to be added again."""
        source = self.source
        self.mapper.finish(
            lambda names, backward: source.images(only=names, backward=backward), self.progress
        )
        if not self.apart:
            return True
        base, _ = load_state(self.request.output, self.request.threads)
        try:
            self._merge(base)
        except ValueError as problem:
            if (base.camera.width, base.camera.height) != source.size():
                shutil.rmtree(self.request.output / CHECKPOINT, ignore_errors=True)
                raise ValueError(f"{self.request.output} stays as it was: {problem}") from None
            self.note(f"not merged: {problem}; frames are now looked for in the map one by one")
            self._extend(by_frame=True)
            return False
        return True

    def _merge(self, base: Mapper) -> None:
        """Merge the map of the frames alone with `base`, the one in the output.

        Raises:
            ValueError: it is empty, or not of the same place.
        """
        own = self.mapper
        if not len(own.structure.ids):
            raise ValueError(no_map(own, self.source))
        self.progress("merge", 0, 0)
        own.scene.set_positions(own.structure.ids, own.structure.positions[own.structure.ids])
        found = align_maps(base.scene, own.scene, threads=self.request.threads)
        if found.problem:
            raise ValueError(found.problem)
        self.known = len(base.structure.frames)
        base.history.begin_run()
        base.history.closing_seconds = own.history.closing_seconds
        insert_map(base, own, found, self.source.path.name)
        base.finish(progress=self.progress)
        self.mapper = base
        self.note(base.history.events[-1])

    def _in_order(self, options: MappingOptions, surveyed: Survey) -> Survey:
        """What the first frames show in the order in which they match, if that is another one."""
        source, known = self.source, surveyed.features
        few = len(source) <= _FEW_PHOTOS
        if not isinstance(source, ImageFolder) or source.timed or (surveyed.ordered and not few):
            return surveyed
        images, count = source.images(), len(source)
        self._order = matching_order(images, count, options.extractor(), known, self.progress)
        if not self._order:
            return surveyed
        self.note("the photos are in no order: each is mapped after one that it matches")
        source.reorder(self._order)
        return self._survey(options, known)

    def _survey(self, options: MappingOptions, known: dict[str, Features] | None = None) -> Survey:
        """What the first frames show, and the region of the image to leave out."""
        self.progress("look at the first frames", 0, 0)
        started = time.perf_counter()
        size = self.source.size()
        surveyed = survey(self.source.images(), options.extractor(), size, known or {})
        matches = [(pair.first, pair.second) for pair in surveyed.pairs]
        mask = static_regions(matches, size, pixel_size(size, options.max_size))
        if region := describe(mask):
            self.note(f"left out, as it never moves while the rest does: {region}")
        if self.request.mask is not None:
            mask |= read_mask(self.request.mask, size)
        surveyed.mask, surveyed.seconds = mask, time.perf_counter() - started
        return surveyed

    def _prepare(self, surveyed: Survey, prefix: str, inputs: dict[str, str]) -> None:
        """Tell mapper and source what is known of the input."""
        source = self.source
        source.prefix = prefix
        self.mapper.features = {prefix + name: f for name, f in surveyed.features.items()}
        self.mapper.mask = surveyed.mask
        self.mapper.history.closing_seconds["initialise"] = surveyed.seconds
        self.facts = {
            "request": request_facts(self.request, source),
            "order": self._order,
            "left_out": self._left_out,
            "prefix": prefix,
            "inputs": {**inputs, str(source.path.resolve()): prefix},
        }

    def add_frames(self) -> bool:
        """Add all frames to the map; returns False if a signal stopped that."""
        with deferred_interrupt(
            lambda: self.note("stopping after this frame (again: at once)")
        ) as interrupted:
            try:
                return self._add_frames(interrupted)
            except KeyboardInterrupt:
                # The frame at hand took too long: the map is as of the last checkpoint.
                folder = self.request.output / CHECKPOINT
                if not interrupted() or not folder.is_dir():
                    raise
                self.mapper, facts = load_state(folder, self.request.threads)
                self.cursor = int(facts["cursor"])
                return False

    def _add_frames(self, interrupted: Callable[[], bool]) -> bool:
        saved = started = time.monotonic()
        first = self.cursor
        images = self._images(self.cursor)
        while True:
            asked = time.perf_counter()
            image = next(images, None)
            waited = time.perf_counter() - asked
            if starts.needs_rivals(self.mapper, at_end=image is None):
                if not self._compete(interrupted):
                    self._save()
                    return False
                first, started = self.cursor, time.monotonic()
            if starts.needs_restart(self.mapper, at_end=image is None):
                # The wrong focal length has bent the first part of the map.
                self.mapper = starts.restart(self.mapper)
                self.note(self.mapper.history.events[-1])
                self.cursor, first, started = 0, 0, time.monotonic()
                images = self._images()
                continue
            if image is None:
                break
            if image.name not in self.mapper.history.records:
                record = self.mapper.add(image)
                if self.request.threads > 1:
                    record.seconds["detect"] += waited
            self.cursor += 1
            if self.recording is not None:
                self.recording.show(self.mapper, image)
            rate = (self.cursor - first) / max(time.monotonic() - started, 1e-9)
            registered = len(self.mapper.structure.frames)
            stage = f"{self._stage()}, {registered} registered, {rate:.1f} frames/s"
            self.progress(stage, self.cursor, max(len(self.source), self.cursor))
            if interrupted() or time.monotonic() - saved > _CHECKPOINT_INTERVAL:
                self._save()
                saved = time.monotonic()
            if interrupted():
                return False
        if self.mapper.calibration is not None:
            self.mapper.calibration.restarts = MAX_RESTARTS
        self._save()
        return True

    def _compete(self, interrupted: Callable[[], bool]) -> bool:
        """Go on with the map of the frames so far that explains most; False if a signal comes."""
        first = islice(self.source.images(), self.cursor)
        images = tracked(first, self.progress, "try other focal lengths", self.cursor)
        again = (self._with_features(image, again=True) for image in images)
        best = starts.compete(self.mapper, again, interrupted)
        if best is None:
            return False
        self.mapper = best
        self.note(f"the focal length of {best.camera.focal_length:.0f} pixels explains most")
        return True

    def _images(self, start: int = 0) -> Iterator[InputImage]:
        """The images; with several threads the features of the next are detected meanwhile."""
        images = self.source.images(start)
        if self.request.threads > 1:
            images = map(self._with_features, images)
        return read_ahead(images, self.request.threads)

    def _with_features(self, image: InputImage, again: bool = False) -> InputImage:
        known = image.name in self.mapper.history.records and not again
        known = known or image.name in self.mapper.features
        if known or image.image is None or image.image.shape[::-1] != self.source.size():
            return image
        return replace(image, features=self.mapper.extractor(image.image))

    def _stage(self) -> str:
        """The name of the stage: a progress bar starts anew with each."""
        calibration = None if self.known else self.mapper.calibration
        restarts = calibration.restarts if calibration else 0
        return "map" if not restarts else f"map (start {restarts + 1})"

    def _save(self) -> None:
        facts = {
            **self.facts,
            "cursor": self.cursor,
            "known": self.known,
            "apart": self.apart,
            "shift": [self.source.first_index, self.source.time_shift],
        }
        save_checkpoint(self.mapper, self.request.output, facts)


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
