"""The incremental pipeline: one frame after the other into one map."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protomark.mapping import adjustment, culling, loop
from protomark.mapping.clock import Clock
from protomark.mapping.history import REGISTERED, Entry, History
from protomark.mapping.initialisation import Initialiser
from protomark.mapping.keyframes import is_keyframe
from protomark.mapping.memory import Memory, make_memory
from protomark.mapping.merging import merge
from protomark.mapping.pose import refine_pose
from protomark.mapping.prediction import predict
from protomark.mapping.settings import Settings
from protomark.mapping.sighting import Sighting
from protomark.mapping.structure import Array, Frame, Structure
from protomark.mapping.tracking import Matches, Tracked, Tracker
from protomark.mapping.triangulation import remember, triangulate
from protomark.tracks.colmap import focal_length, rays
from protomark.tracks.features import Extractor
from protomark.tracks.file import Camera

# Fewer keypoints than this are a black or blurred frame.
_MIN_KEYPOINTS = 50
# Keyframes that local bundle adjustment moves, and the most steps it takes.
_LOCAL_SIZE = 10
_LOCAL_ITERATIONS = 8
# The whole map is adjusted whenever it has grown by this factor.
_GROWTH = 1.5
_FIRST_GLOBAL = 6
# A map with fewer keyframes that loses this many frames in a row was begun wrongly.
_YOUNG = 4
_YOUNG_LOSSES = 3
# A pose under which less of what is in view is seen is held against one from the whole map.
_DOUBTFUL = 0.3
_LOOP_EVERY = 3
# A guessed focal length that the map finds to be off by more than this made a bad beginning. So
# many keyframes tell, or all there are: from the first ones of `hololens` it comes out at 530 to
# 790 pixels and is 495.
_GUESS_OFF = 0.05
_CALIBRATED = 196
_LOOP_SCALE = 8.0


@dataclass
class Picture:
    """One image of the input.

    Attributes:
        index: place in its input, from 0.
        name: unique name.
        time: seconds, or the index.
        image: (height, width) uint8, None where it cannot be read; then `trouble` says why.
        pose: (3, 4) given pose, or None.
        trouble: why there is no image.
    """

    index: int
    name: str
    time: float
    image: NDArray[np.uint8] | None
    pose: Array | None = None
    trouble: str = ""


class Mapper:
    """A map in the making.

    Args:
        settings: how to make it.
        camera: camera of the frames to come.
        threads: threads to search and adjust on.
    """

    def __init__(self, settings: Settings, camera: Camera, threads: int = 1) -> None:
        self.settings, self.threads = settings, threads
        self.structure = Structure()
        self.memory: Memory = make_memory(settings)
        self.history = History()
        self.clock = Clock()
        self.camera_id = 1
        self.structure.cameras[1] = camera
        self.next_global = _FIRST_GLOBAL
        self.lost_in_row = 0
        self.looking_again = False
        # Focal length that the map began with, 0 where that is settled; whether it has begun again.
        self.guess = focal_length(camera) if settings.calibrate else 0.0
        self.begun_again = False
        self._extractor = Extractor(settings.descriptor, settings.max_keypoints)
        self._start_over()

    # State that lives between two frames and is no part of the map.

    def _start_over(self) -> None:
        self.initialiser = Initialiser(self.camera, self._pixels(self.settings.max_error))

    @property
    def camera(self) -> Camera:
        """Camera of the frames to come."""
        return self.structure.cameras[self.camera_id]

    @property
    def tracker(self) -> Tracker:
        """Finds frames in the map as it is."""
        s = self.settings
        return Tracker(self.structure, self.memory, s.max_error, s.min_inliers, self.threads)

    @property
    def width(self) -> int:
        """Bytes of a descriptor."""
        return self._extractor.kind.bytes

    def _pixels(self, share: float) -> float:
        return self.structure.tolerance(self.camera_id, share)

    # The camera.

    def misjudged(self, ended: bool = False) -> bool:
        """Whether the camera is so unlike the guess that the map should begin again with it.

        Args:
            ended: no frame is left, so what keyframes there are must tell.
        """
        if not self.guess or self.begun_again:
            return False
        keyframes = len(self.structure.keyframes())
        if keyframes < (_FIRST_GLOBAL if ended else _CALIBRATED):
            return False
        if ended:
            self._adjust_all(2)
        return abs(focal_length(self.camera) / self.guess - 1) > _GUESS_OFF

    def begin_again(self) -> Mapper:
        """An empty map with the camera as it was found."""
        new = Mapper(self.settings, self.camera, self.threads)
        new.begun_again = True
        new.history.events.append(
            f"the map begins again: focal length {new.guess:.0f}, not {self.guess:.0f} pixels"
        )
        return new

    # One frame.

    def add(self, picture: Picture) -> Entry:
        """Take up the next frame; says what became of it."""
        self.clock.lap()
        entry = self.history.entries.get(picture.name)
        again = entry is not None
        if entry is None:
            entry = self.history.entries[picture.name] = Entry(picture.index, picture.name, "")
        sighting = self._look(picture, entry)
        if sighting is not None:
            if self.settings.fixed_poses and picture.pose is None:
                entry.outcome = "no pose is given for it"
            elif picture.pose is not None:
                self._place(sighting, picture.pose, entry)
            elif self.structure.frames:
                self._track(sighting, entry)
                self._doubt(entry)
            else:
                self._initialise(sighting, entry)
        if not again:
            self._measure(entry)
        for stage, seconds in self.clock.lap().items():
            entry.seconds[stage] = entry.seconds.get(stage, 0.0) + seconds
        return entry

    def _look(self, picture: Picture, entry: Entry) -> Sighting | None:
        if picture.image is None:
            entry.outcome = picture.trouble
            return None
        height, width = picture.image.shape
        camera = self.camera
        if (width, height) != (camera.width, camera.height):
            entry.outcome = (
                f"{width}x{height} pixels, but the camera has {camera.width}x{camera.height}"
            )
            return None
        with self.clock.stage("detect"):
            features = self._extractor(picture.image)
        entry.keypoints = len(features)
        if len(features) < _MIN_KEYPOINTS:
            entry.outcome = f"only {len(features)} keypoints: black, blurred or without texture"
            return None
        with self.clock.stage("encode"):
            encoded = self.memory.encode(features.descriptors)
        return Sighting(
            picture.index,
            picture.name,
            picture.time,
            self.camera_id,
            features.keypoints,
            rays(camera, features.keypoints),
            features.descriptors,
            encoded,
        )

    # The first two frames.

    def _initialise(self, sighting: Sighting, entry: Entry) -> None:
        with self.clock.stage("initialise"):
            found = self.initialiser.push(sighting)
        if found is None:
            entry.outcome = "before the first two frames with enough parallax"
            return
        waiting = self.initialiser.waiting
        first, second = waiting[found.first], waiting[found.second]
        origin = np.eye(3, 4)
        for one, pose in ((first, origin), (second, found.pose)):
            self.structure.frames.append(one.at(pose))
        self._triangulate(1)
        if len(self.structure.ids) < 2 * self.settings.min_inliers:
            return self._give_up(entry, "the first two frames share too few landmarks")
        with self.clock.stage("adjust"):
            adjustment.adjust(self.structure, [0, 1], [], iterations=20)
            self._normalise()
            self._cull([0, 1])
        for one in (first, second):
            self._register(one.name, self.structure.frames[0 if one is first else 1])
        # The frames between, then those before, from near to far.
        between = waiting[found.first + 1 : found.second]
        for one in [*between, *waiting[: found.first][::-1]]:
            self._track(one, self.history.entries[one.name])
        if len(between) > 1 and len(self.structure.frames) < 2 + len(between) // 2:
            return self._give_up(entry, "the frames between the first two do not fit them")
        self.history.events.append(
            f"{second.name}: the map begins, with {first.name} and this frame"
        )
        self._start_over()
        self.lost_in_row = 0
        return None

    def _give_up(self, entry: Entry, reason: str) -> None:
        """Forget a map that was begun wrongly, and look for another start."""
        for frame in self.structure.frames:
            known = self.history.entries[frame.name]
            known.outcome, known.inliers, known.keyframe = f"begun wrongly: {reason}", 0, False
        entry.outcome = reason
        camera, waiting = self.camera, self.initialiser.waiting[-1:]
        self.structure = Structure({self.camera_id: camera})
        self.memory = make_memory(self.settings)
        self.next_global, self.lost_in_row = _FIRST_GLOBAL, 0
        self._start_over()
        self.initialiser.waiting = waiting

    def _normalise(self) -> None:
        """Median depth of the first frame 1."""
        structure = self.structure
        pose = structure.frames[0].pose
        depth = structure.positions[structure.ids] @ pose[2, :3] + pose[2, 3]
        scale = 1 / float(np.median(depth))
        structure.positions *= scale
        for frame in structure.frames:
            frame.pose[:, 3] *= scale
        structure.look_again()

    # Every other frame.

    def _track(self, sighting: Sighting, entry: Entry) -> None:
        with self.clock.stage("match"):
            found = self._find(sighting)
        if found is None:
            self.lost_in_row += 1
            entry.outcome = "not found in the map: too few matches agree on a pose"
            return
        self.lost_in_row = 0
        self._take_up(sighting, found, entry)

    def _doubt(self, entry: Entry) -> None:
        """A map that loses the camera when it has just begun was begun wrongly."""
        young = len(self.structure.keyframes()) < _YOUNG and not self.looking_again
        if young and self.lost_in_row >= _YOUNG_LOSSES:
            self._give_up(entry, "the map was lost when it had just begun")

    def _find(self, sighting: Sighting) -> Tracked | None:
        predicted = predict(self.structure.frames, sighting.index, sighting.camera_id)
        found = None
        if predicted is not None:
            found = self.tracker.track(sighting, predicted)
        if found is None or found.share < _DOUBTFUL:
            # A wrong prediction may have led to a wrong pose.
            rough = self.tracker.relocalize(sighting)
            other = self.tracker.settle(sighting, rough.pose) if rough else None
            if found is None or (other and len(other.matches) > len(found.matches)):
                found = other
        return found

    def _place(self, sighting: Sighting, pose: Array, entry: Entry) -> None:
        """A frame whose pose is given."""
        matches = Matches(np.zeros(0, np.int64), np.zeros(0, np.int64))
        if len(self.structure.ids):
            with self.clock.stage("match"):
                matches = self.tracker.guided(sighting, pose, 1.5 * self.settings.max_error)
        self._take_up(sighting, Tracked(pose, matches), entry)

    def _take_up(self, sighting: Sighting, found: Tracked, entry: Entry) -> None:
        """A frame with a pose becomes part of the map, and updates what it sees (Eq. 2)."""
        structure = self.structure
        frame = sighting.at(found.pose)
        keyframes = structure.keyframes()
        structure.observe(frame, found.matches.rows, found.matches.ids)
        last = structure.frames[keyframes[-1]] if keyframes else None
        frame.keyframe = is_keyframe(structure, last, frame)
        structure.frames.append(frame)
        remember(self.memory, frame, frame.observed)
        place = len(structure.frames) - 1
        if frame.keyframe:
            self._grow(place)
        else:
            frame.forget()
        self._register(sighting.name, frame)

    def _register(self, name: str, frame: Frame) -> None:
        entry = self.history.entries[name]
        entry.outcome, entry.keyframe = REGISTERED, frame.keyframe
        entry.inliers = len(frame.seen)

    def _window(self) -> list[int]:
        return [i for i, f in enumerate(self.structure.frames) if f.descriptors is not None]

    def _triangulate(self, place: int) -> None:
        s = self.settings
        with self.clock.stage("triangulate"):
            window = [i for i in self._window() if i != place]
            same = triangulate(self.structure, self.memory, place, window, s.max_error, s.min_angle)
            merge(self.structure, self.memory, same, s.max_error)

    def _cull(self, frames: list[int]) -> None:
        s = self.settings
        culling.cull(self.structure, self.memory, frames, s.max_error, s.min_angle)

    def _grow(self, place: int) -> None:
        """What a new keyframe brings: landmarks, adjustment, and places seen before."""
        self._triangulate(place)
        with self.clock.stage("adjust"):
            if not self.settings.fixed_poses:
                moved = adjustment.adjust_local(
                    self.structure, place, _LOCAL_SIZE, _LOCAL_ITERATIONS
                )
            else:
                moved = self._window()
                adjustment.adjust(self.structure, [], moved, 0)
            self._cull(moved)
        for i in self._window()[: -self.settings.window]:
            self.structure.frames[i].forget()
        keyframes = len(self.structure.keyframes())
        often = 1 if self.looking_again else _LOOP_EVERY
        if not self.settings.fixed_poses and keyframes % often == 0:
            self._close_loop(place)
        if keyframes >= self.next_global:
            self.next_global = int(keyframes * _GROWTH) + 1
            self._adjust_all(2)

    def _close_loop(self, place: int) -> None:
        with self.clock.stage("match"):
            merged, drift = loop.revisit(
                self.structure, self.memory, self.tracker, place, self.settings.max_error
            )
        if merged or drift:
            self.history.events.append(
                f"{self.structure.frames[place].name}: a place seen before, "
                f"{merged} landmarks merged" + (", drift taken back" if drift else "")
            )
        if drift:
            with self.clock.stage("adjust"):
                adjustment.adjust_global(
                    self.structure, 20, loss_scale=_LOOP_SCALE, threads=self.threads
                )
            self._adjust_all(1)

    def _adjust_all(self, rounds: int) -> None:
        """Global bundle adjustment, with the camera if it is being calibrated, and culling."""
        structure, s = self.structure, self.settings
        # What all frames told is not given up for what the first ones say.
        held = self.begun_again and self.guess and len(structure.keyframes()) < _CALIBRATED
        with self.clock.stage("adjust"):
            for _ in range(rounds):
                adjustment.adjust_global(
                    structure,
                    intrinsics=s.calibrate and not held,
                    poses=not s.fixed_poses,
                    threads=self.threads,
                )
                self._cull(structure.keyframes())
            self._follow()

    def _follow(self) -> None:
        """Frames that are no keyframes follow the landmarks that they see."""
        if self.settings.fixed_poses:
            return
        structure = self.structure
        for frame in structure.frames:
            rows = frame.observed
            if not frame.keyframe and len(rows) >= 6:
                frame.pose, _ = refine_pose(
                    structure.cameras[frame.camera_id],
                    frame.keypoints[rows].astype(np.float64),
                    structure.positions[frame.landmarks[rows]],
                    frame.pose,
                    structure.tolerance(frame.camera_id, self.settings.max_error),
                )

    # The end.

    def finish(
        self,
        again: Callable[[set[str], bool], Iterable[Picture]] | None = None,
        done: Callable[[int, int], None] = lambda done, total: None,
    ) -> None:
        """Look once more for frames that were not found, adjust everything, forget descriptors.

        Args:
            again: gives the pictures of some names once more, in their order or backward; None:
                no second look.
            done: called with frames looked at again, and how many there are.
        """
        self.clock.lap()
        if again is not None and self.structure.frames and not self.settings.fixed_poses:
            self._second_looks(again, done)
        if self.structure.frames:
            self._adjust_all(2)
        for frame in self.structure.frames:
            frame.descriptors = frame.encoded = None
        # The window is gone: what was never confirmed goes now.
        with self.clock.stage("adjust"):
            culling.discard_weak(
                self.structure, self.memory, self.structure.ids, self.settings.min_angle
            )
        for frame in self.structure.frames:
            frame.forget()
        later = self.clock.lap()
        for name, seconds in later.items():
            self.history.later[name] = self.history.later.get(name, 0.0) + seconds

    def _second_looks(
        self,
        again: Callable[[set[str], bool], Iterable[Picture]],
        done: Callable[[int, int], None],
    ) -> None:
        """Backward first: a frame that was not found yet often leads to one that was."""
        self.looking_again = True
        fruitless = 0
        backward = True
        while fruitless < 2:
            missing = {
                e.name
                for e in self.history.entries.values()
                if e.outcome != REGISTERED and e.keypoints >= _MIN_KEYPOINTS
            }
            found = 0
            for number, picture in enumerate(again(missing, backward), 1):
                found += self.add(picture).outcome == REGISTERED
                done(number, len(missing))
            if found == len(missing):
                return
            fruitless = 0 if found else fruitless + 1
            backward = not backward

    def _measure(self, entry: Entry) -> None:
        structure = self.structure
        entry.landmarks = len(structure.ids)
        entry.observations = len(structure.pairs()[0])
        entry.memory_bytes = self.memory.bytes
        entry.descriptor_bytes = self.width * entry.observations
        entry.window_bytes = self.width * sum(
            len(f.keypoints) for f in structure.frames if f.descriptors is not None
        )
