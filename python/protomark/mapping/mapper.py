"""The incremental pipeline: one frame after the other into one map."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

import protomark as pm
from protomark.features.extractor import Features
from protomark.features.static_regions import Mask, outside
from protomark.geometry.absolute_pose import refine_pose
from protomark.geometry.camera import Camera
from protomark.mapping import adjustment, culling, loop, trust
from protomark.mapping.clock import Clock
from protomark.mapping.frame import Array, Frame, InputImage, keypoint_sigma
from protomark.mapping.history import REGISTERED, FrameRecord, History
from protomark.mapping.initialisation import Initialiser, TwoViewPose
from protomark.mapping.keyframes import is_keyframe
from protomark.mapping.memory import Memory, Prototypes, prototypes_for
from protomark.mapping.merging import merge_duplicates
from protomark.mapping.options import MappingOptions
from protomark.mapping.prediction import predict
from protomark.mapping.self_calibration import Calibration
from protomark.mapping.structure import Structure
from protomark.mapping.tracking import LandmarkMatches, TrackedPose, Tracker
from protomark.mapping.triangulation import triangulate, update_prototypes
from protomark.progress import Progress, silent

# Yields the images of these names again, in their order or, if the flag is set, backward.
Reread = Callable[[set[str], bool], Iterable[InputImage]]

# A frame with fewer keypoints is black or blurred.
_MIN_KEYPOINTS = 50
# Local bundle adjustment moves this many keyframes, in at most so many steps.
_LOCAL_SIZE = 10
_LOCAL_ITERATIONS = 2
# Global bundle adjustment follows whenever the number of keyframes has grown by this factor.
_GROWTH = 1.5
FIRST_GLOBAL = 6
# A map with fewer keyframes that loses this many frames in a row was initialised wrongly.
_YOUNG_KEYFRAMES = 4
_MAX_YOUNG_LOSSES = 3
# A tracked pose that matches a smaller share of the landmarks in view is checked by relocalization.
_MIN_TRACKED_SHARE = 0.3
_LOOP_EVERY = 3
LOOP_LOSS_SCALE = 8.0


class Mapper:
    """Makes a map from one frame after the other."""

    def __init__(
        self,
        options: MappingOptions,
        camera: Camera,
        threads: int = 1,
        new_memory: Callable[[MappingOptions], Memory] = prototypes_for,
    ) -> None:
        self.options, self.threads = options, threads
        self.new_memory = new_memory
        self.structure = Structure({1: camera}, options)
        self.memory = new_memory(options)
        self.history = History()
        self.clock = Clock()
        self.camera_id = 1
        self.next_global = FIRST_GLOBAL
        self.lost_in_row = 0
        self.retrying = False
        self.calibration = Calibration(camera.focal_length) if options.calibrate else None
        # Features that are known already, and the part of the image that is left out.
        self.features: dict[str, Features] = {}
        self.mask: Mask | None = None
        self.extractor = options.extractor()
        self._reset_initialiser()

    @property
    def camera(self) -> Camera:
        """Camera of the next frames."""
        return self.structure.cameras[self.camera_id]

    @property
    def scene(self) -> pm.PrototypeMap:
        """The map of prototypes."""
        if not isinstance(self.memory, Prototypes):
            raise TypeError("this mapper's memory holds no prototypes, so it has no map to save")
        return self.memory.map

    @property
    def tracker(self) -> Tracker:
        """Finds frames in the current map."""
        return Tracker(self.structure, self.memory, self.threads)

    @property
    def descriptor_bytes(self) -> int:
        """Bytes of a descriptor."""
        return self.extractor.kind.bytes

    # The paper's Section 3: detect, track or relocalize, observe, and extend the map by keyframes.

    def add(self, image: InputImage) -> FrameRecord:
        """Add the next frame to the map; the record says what became of it."""
        self.clock.lap()
        first_time = image.name not in self.history.records
        record = self.history.records.setdefault(
            image.name, FrameRecord(image.index, image.name, "")
        )
        frame = self._detect(image, record)
        if frame is not None:
            if image.pose is not None:
                self._register_given_pose(frame, image.pose)
            elif self.options.fixed_poses:
                record.outcome = "no pose is given for it"
            elif self.structure.frames:
                self._register(frame, record)
                self._check_young_map(record)
            else:
                self._initialise(frame, record)
        if first_time:
            self._measure(record)
        for stage, seconds in self.clock.lap().items():
            record.seconds[stage] = record.seconds.get(stage, 0.0) + seconds
        return record

    def _register(self, frame: Frame, record: FrameRecord) -> None:
        """Track or relocalize a frame, and update the map with it."""
        found = self._track_or_relocalize(frame)
        if found is None or self._is_uncertain(frame, found):
            self.lost_in_row += 1
            record.outcome = trust.NOT_FOUND if found is None else trust.UNCERTAIN
            return
        self.lost_in_row = 0
        self._insert_frame(frame, found)

    def _is_uncertain(self, frame: Frame, found: TrackedPose) -> bool:
        return trust.is_uncertain(self.structure, frame, found.pose, found.matches)

    def shows(self, image: InputImage) -> bool:
        """Whether a frame is found in the map, which does not take it."""
        frame = self._detect(image, FrameRecord(image.index, image.name, ""))
        found = None if frame is None else self._track_or_relocalize(frame)
        return frame is not None and found is not None and not self._is_uncertain(frame, found)

    def _insert_frame(self, frame: Frame, found: TrackedPose) -> None:
        """Update the landmarks that a frame observes (Eq. 2); extend the map by a keyframe."""
        index = self._observe(frame, found)
        if self.structure.frames[index].keyframe:
            self._triangulate(index)
            adjusted = self._adjust_local_bundle(index)
            self._cull(adjusted)
            self._shrink_window()
            self._close_loop(index)
            self._adjust_global_bundle_if_grown()
        self._record(index)

    def _detect(self, image: InputImage, record: FrameRecord) -> Frame | None:
        """Detect, describe and encode the keypoints of an image; None if it is not usable."""
        if image.image is None:
            record.outcome = image.problem
            return None
        height, width = image.image.shape
        camera_id = self.id_of_camera(image.camera)
        camera = self.structure.cameras[camera_id]
        if (width, height) != (camera.width, camera.height):
            record.outcome = (
                f"{width}x{height} pixels, but the camera has {camera.width}x{camera.height}"
            )
            return None
        with self.clock.stage("detect"):
            features = image.features or self.features.get(image.name)
            features = features or self.extractor(image.image)
            if self.mask is not None and self.mask.shape == image.image.shape:
                features = features.where(outside(self.mask, features.keypoints))
        record.keypoints = len(features)
        if len(features) < _MIN_KEYPOINTS:
            record.outcome = f"only {len(features)} keypoints: black, blurred or without texture"
            return None
        with self.clock.stage("encode"):
            encoded = self.memory.encode(features.descriptors)
        rays, turns = camera.local_rays(features.keypoints)
        return Frame(
            image.index,
            image.name,
            image.time,
            camera_id,
            features.keypoints,
            rays,
            self.structure.pixel(camera_id) * keypoint_sigma(features.sizes),
            features.descriptors,
            encoded,
            turns=turns,
        )

    def id_of_camera(self, camera: Camera | None) -> int:
        """The id of a camera, a new one if no frame had it; None: that of the next frames."""
        cameras = self.structure.cameras
        if camera is None:
            return self.camera_id
        known = (i for i, other in cameras.items() if other == camera)
        camera_id = next(known, max(cameras) + 1)
        cameras[camera_id] = camera
        return camera_id

    def _track_or_relocalize(self, frame: Frame) -> TrackedPose | None:
        """The pose of a frame near the one that its neighbours predict, or anywhere in the map."""
        with self.clock.stage("match"):
            predicted = predict(self.structure.frames, frame.index, frame.camera_id)
            found = None if predicted is None else self.tracker.track(frame, predicted)
            if found is None or found.share < _MIN_TRACKED_SHARE:
                # A wrong prediction may lead to a wrong pose.
                rough = self.tracker.relocalize(frame)
                other = self.tracker.track_local_map(frame, rough.pose) if rough else None
                if found is None or (other and len(other.matches) > len(found.matches)):
                    found = other
        return found

    def _observe(self, frame: Frame, found: TrackedPose) -> int:
        """Update the prototypes that a frame observes (Eq. 2); returns the frame's index."""
        structure = self.structure
        frame = frame.at(found.pose)
        keyframes = structure.keyframes()
        structure.observe(frame, found.matches.rows, found.matches.ids)
        last = structure.frames[keyframes[-1]] if keyframes else None
        frame.keyframe = is_keyframe(structure, last, frame)
        structure.frames.append(frame)
        update_prototypes(self.memory, frame, frame.observed)
        if not frame.keyframe:
            frame.leave_window()
        return len(structure.frames) - 1

    def _triangulate(self, index: int) -> None:
        """Create landmarks from the descriptors of the window (Eq. 1), and merge duplicates."""
        with self.clock.stage("triangulate"):
            window = [i for i in self._window() if i != index]
            duplicates = triangulate(self.structure, self.memory, index, window)
            merge_duplicates(self.structure, self.memory, duplicates)

    def _adjust_local_bundle(self, index: int) -> list[int]:
        """Adjust the keyframes around a new one; returns their indices."""
        with self.clock.stage("adjust"):
            if self.options.fixed_poses:
                window = self._window()
                adjustment.adjust(self.structure, [], window, 5)
                return window
            return adjustment.adjust_local_bundle(
                self.structure, index, _LOCAL_SIZE, _LOCAL_ITERATIONS
            )

    def _cull(self, frames: list[int]) -> None:
        """Remove observations of these frames, and landmarks, that do not fit."""
        with self.clock.stage("adjust"):
            culling.cull(self.structure, self.memory, frames)

    def _shrink_window(self) -> None:
        """Drop the descriptors of all but the latest keyframes."""
        for i in self._window()[: -self.options.window]:
            self.structure.frames[i].leave_window()

    def _close_loop(self, index: int) -> None:
        """Merge landmarks of a place seen before, and correct the drift since then."""
        interval = 1 if self.retrying else _LOOP_EVERY
        if self.options.fixed_poses or len(self.structure.keyframes()) % interval:
            return
        with self.clock.stage("match"):
            merged, drift = loop.close_loop(self.tracker, index)
        if merged or drift:
            self.history.events.append(
                f"{self.structure.frames[index].name}: a place seen before, {merged} landmarks "
                f"merged{', drift corrected' if drift else ''}"
            )
        if drift:
            with self.clock.stage("adjust"):
                adjustment.adjust_global_bundle(self.structure, 20, loss_scale=LOOP_LOSS_SCALE)
            self.adjust_global_bundle(1)

    def _adjust_global_bundle_if_grown(self) -> None:
        keyframes = len(self.structure.keyframes())
        if keyframes >= self.next_global:
            self.next_global = int(keyframes * _GROWTH) + 1
            self.adjust_global_bundle(1, iterations=4)

    def adjust_global_bundle(self, rounds: int, iterations: int = 10) -> None:
        """Adjust and cull the whole map, and the camera if it is being calibrated."""
        structure = self.structure
        with self.clock.stage("adjust"):
            for _ in range(rounds):
                adjustment.adjust_global_bundle(
                    structure,
                    iterations=iterations if self.calibration is None else 30,
                    calibration=self.calibration,
                    poses=not self.options.fixed_poses,
                )
                self._cull(structure.keyframes())
            self._refine_other_frames()

    def _refine_other_frames(self) -> None:
        """Refine the poses of frames that are not keyframes on the landmarks they observe."""
        if self.options.fixed_poses:
            return
        structure = self.structure
        for frame in structure.frames:
            rows = frame.observed
            if not frame.keyframe and len(rows) >= 6:
                matched = structure.matched(frame, rows, frame.seen)
                limit = structure.max_error(frame.camera_id)
                frame.pose, _ = refine_pose(frame.pose, *matched, limit)

    def _window(self) -> list[int]:
        return [i for i, frame in enumerate(self.structure.frames) if frame.in_window]

    def _record(self, index: int) -> None:
        frame = self.structure.frames[index]
        record = self.history.records[frame.name]
        record.outcome, record.keyframe = REGISTERED, frame.keyframe
        record.inliers = len(frame.seen)

    def _register_given_pose(self, frame: Frame, pose: Array) -> None:
        """Register a frame whose pose is given, unless the map contradicts that."""
        matches, o = LandmarkMatches(np.zeros(0, np.int64), np.zeros(0, np.int64)), self.options
        if len(self.structure.ids):
            with self.clock.stage("match"):
                matches = self.tracker.match_projected(frame, pose, 1.5 * o.max_error)
                few = len(matches) < o.min_inliers
                if few and trust.taken_elsewhere(self.tracker, frame, pose):
                    self.history.records[frame.name].outcome = trust.ELSEWHERE
                    return
        self._insert_frame(frame, TrackedPose(pose, matches))

    # Initialisation.

    def _reset_initialiser(self) -> None:
        self.initialiser = Initialiser(self.structure)

    def _initialise(self, frame: Frame, record: FrameRecord) -> None:
        """Start the map with two frames once a pair has enough parallax."""
        with self.clock.stage("initialise"):
            pair = self.initialiser.push(frame)
        if pair is None:
            record.outcome = trust.WAITING
            return
        waiting = self.initialiser.waiting
        first, second = waiting[pair.first], waiting[pair.second]
        if not self._start_map(first, second, pair):
            self._abort_initialisation(record, "the first two frames share too few landmarks")
            return
        # The frames between the two come first, then those before, from near to far.
        between = waiting[pair.first + 1 : pair.second]
        for one in [*between, *waiting[: pair.first][::-1]]:
            self._register(one, self.history.records[one.name])
        if len(between) > 1 and len(self.structure.frames) < 2 + len(between) // 2:
            reason = "the frames between the first two do not fit them"
            self._abort_initialisation(record, reason)
            return
        self.history.events.append(
            f"{second.name}: the map starts with {first.name} and this frame"
        )
        self._reset_initialiser()
        self.lost_in_row = 0

    def _start_map(self, first: Frame, second: Frame, pair: TwoViewPose) -> bool:
        """Triangulate and adjust two frames; False if they share too few landmarks."""
        self.structure.frames += [first.at(np.eye(3, 4)), second.at(pair.pose)]
        self._triangulate(1)
        if len(self.structure.ids) < 2 * self.options.min_inliers:
            return False
        with self.clock.stage("adjust"):
            adjustment.adjust(self.structure, [1], [0], iterations=20)
            self._normalise_scale()
            self._cull([0, 1])
        self._record(0)
        self._record(1)
        return True

    def _normalise_scale(self) -> None:
        """Scale the map so that the median depth in the first frame is 1."""
        structure = self.structure
        pose = structure.frames[0].pose
        depth = structure.positions[structure.ids] @ pose[2, :3] + pose[2, 3]
        scale = 1 / float(np.median(np.abs(depth)))
        structure.positions *= scale
        for frame in structure.frames:
            frame.pose[:, 3] *= scale
        structure.recompute_views()

    def _abort_initialisation(self, record: FrameRecord, reason: str) -> None:
        """Discard a map that was initialised wrongly, and wait for another pair of frames."""
        for frame in self.structure.frames:
            old = self.history.records[frame.name]
            old.outcome, old.inliers, old.keyframe = f"initialised wrongly: {reason}", 0, False
        record.outcome = reason
        waiting = self.initialiser.waiting[-1:]
        self.structure = Structure(self.structure.cameras, self.options)
        self.memory = self.new_memory(self.options)
        self.next_global, self.lost_in_row = FIRST_GLOBAL, 0
        self._reset_initialiser()
        self.initialiser.waiting = waiting

    def _check_young_map(self, record: FrameRecord) -> None:
        """Abort a map that loses the camera when it has just started."""
        young = len(self.structure.keyframes()) < _YOUNG_KEYFRAMES and not self.retrying
        if young and self.lost_in_row >= _MAX_YOUNG_LOSSES:
            self._abort_initialisation(record, "the map lost the camera when it had just started")

    # The end.

    def finish(self, reread: Reread | None = None, progress: Progress = silent) -> None:
        """Retry frames that were not found, adjust everything, and drop the descriptors."""
        self.clock.lap()
        if reread is not None and self.structure.frames and not self.options.fixed_poses:
            self._retry_lost_frames(reread, progress)
        progress("adjust", 0, 0)
        if self.structure.frames:
            self.adjust_global_bundle(2)
            self._remove_untrusted_frames()
        for frame in self.structure.frames:
            frame.descriptors = None
        # With an empty window every landmark counts as old, and unconfirmed ones are culled.
        with self.clock.stage("adjust"):
            culling.cull_landmarks(self.structure, self.memory, self.structure.ids)
        if self.structure.frames:
            self.adjust_global_bundle(1)
            self._check_calibration()
        for frame in self.structure.frames:
            frame.leave_window()
        self.history.count(self.clock.lap())

    def _check_calibration(self) -> None:
        """Note which other focal lengths fit as well."""
        if self.calibration is not None and not self.calibration.given:
            with self.clock.stage("adjust"):
                factors = adjustment.other_factors(self.structure)
            self.calibration.others = [k * self.camera.focal_length for k in factors]

    def _remove_untrusted_frames(self) -> None:
        """Remove frames whose poses fail the checks: they do not count as registered."""
        structure = self.structure
        failed = {} if self.options.fixed_poses else trust.untrusted_frames(structure)
        culling.remove_observations(structure, self.memory, structure.observations(list(failed)))
        for i, reason in failed.items():
            record = self.history.records[structure.frames[i].name]
            record.outcome, record.keyframe, record.inliers = reason, False, 0
        structure.frames = [f for i, f in enumerate(structure.frames) if i not in failed]
        if failed:
            structure.recompute_views()

    def _retry_lost_frames(self, reread: Reread, progress: Progress) -> None:
        """Retry lost frames, backward first: most precede a registered frame that leads to them."""
        self.retrying = True
        failed_passes, backward = 0, True
        while failed_passes < 2:
            lost = {
                record.name
                for record in self.history.records.values()
                if record.outcome != REGISTERED and record.keypoints >= _MIN_KEYPOINTS
            }
            found = 0
            for number, image in enumerate(reread(lost, backward), 1):
                found += self.add(image).outcome == REGISTERED
                progress("retry lost frames", number, len(lost))
            if found == len(lost):
                return
            failed_passes = 0 if found else failed_passes + 1
            backward = not backward

    def _measure(self, record: FrameRecord) -> None:
        """Record the size of the map after a frame."""
        structure = self.structure
        record.landmarks = len(structure.ids)
        record.observations = len(structure.pairs()[0])
        record.memory_bytes = self.memory.bytes
        record.descriptor_bytes = self.descriptor_bytes * record.observations
        record.window_bytes = self.descriptor_bytes * sum(
            len(frame.keypoints) for frame in structure.frames if frame.in_window
        )
