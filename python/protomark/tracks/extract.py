"""Extracts tracks from images with a COLMAP sparse model."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark
from protomark.extras import optional
from protomark.features.descriptors import InputKind, descriptor_kind
from protomark.features.extractor import MAX_SIZE, Extractor, Features, reduced_size
from protomark.features.images import image_names, read_gray
from protomark.features.static_regions import Mask, describe, outside, static_regions
from protomark.files import hash_files
from protomark.geometry import colmap
from protomark.geometry.given_poses import agreeing, misfit, pose_errors
from protomark.geometry.pose import pose_at, turned
from protomark.progress import Progress, silent
from protomark.threads import parallel_map
from protomark.tracks import completion, pairs, triangulation
from protomark.tracks.file import Tracks
from protomark.tracks.matching import VerifiedMatches, View, match, mutual_matches, with_errors
from protomark.tracks.scene import Scene

Pairs = dict[tuple[int, int], VerifiedMatches]

# Matches may be this far (pixels) from the epipolar line until the error of the poses is known.
_ROUGH_ERROR = 16.0
# Epipolar error (pixels, median over pairs of the pair's median of verified matches) from which on
# `refine_poses="auto"` tries to refine poses. Structure from motion has 0.2 to 0.6, poses of other
# sensors have 0.5 to 1.3.
_ROUGH_POSES = 0.6
# Refined poses are kept if so many more of the verified matches fit them within a pixel. True poses
# gain 1.1 to 1.2 by fitting noise, rough ones 1.9.
_CLEARLY_MORE = 1.25
_REFINE_ERRORS = (12.0, 4.0)
# Each image's strongest keypoints take part in refinement; more cost time and do not lower the
# error.
_REFINE_KEYPOINTS = 700
_COMPLETION_PASSES = 3
# Neighbours of so many keyframes tell about all poses.
_SAMPLE = 20
# Increased whenever the same options yield other tracks, so that old files are made anew.
_METHOD = 5


@dataclass(frozen=True)
class TracksOptions:
    """How tracks are made."""

    # Name of the descriptor, see `protomark.features.descriptors.DESCRIPTORS`.
    descriptor: str = "freak"
    max_keypoints: int = 2000  # limit on keypoints per image
    # Images with a longer side are reduced to it before detection; errors count in their pixels.
    max_size: int = MAX_SIZE
    partners: int = 24  # about how many keyframes each keyframe is matched with
    ratio: float = 0.8  # limit on the ratio of the nearest to the second nearest distance
    max_error: float = 3.0  # largest epipolar and reprojection error, pixels
    min_angle: float = 1.0  # smallest triangulation angle of a landmark, degrees
    min_length: int = 3  # smallest number of observations of a landmark
    refine_poses: str = "auto"  # "yes", "no", or "auto": if the matches do not fit the poses
    # Limit on keypoints without a landmark per keyframe, the strongest; None: no limit. A limit
    # makes smaller files, but query frames that lack keypoints which match nothing.
    max_unlabelled: int | None = None
    # The detector of another program with its settings, as maps of it are read; None: OpenCV's.
    detector: Mapping[str, Any] | None = None

    @property
    def kind(self) -> InputKind:
        """What the descriptor is of."""
        return descriptor_kind(self.descriptor).input

    def __post_init__(self) -> None:
        object.__setattr__(self, "descriptor", descriptor_kind(self.descriptor).name)
        unlabelled = self.max_unlabelled
        checks = (
            ("max_keypoints", self.max_keypoints >= 2, "at least 2"),
            ("partners", self.partners >= 1, "at least 1"),
            ("ratio", 0 < self.ratio <= 1, "in (0, 1]"),
            ("max_error", 0 < self.max_error <= _ROUGH_ERROR, f"in (0, {_ROUGH_ERROR:g}]"),
            ("min_angle", 0 <= self.min_angle < 90, "in [0, 90)"),
            ("min_length", self.min_length >= 2, "at least 2"),
            ("max_unlabelled", unlabelled is None or unlabelled >= 0, "at least 0"),
            ("refine_poses", self.refine_poses in ("auto", "yes", "no"), "auto, yes or no"),
        )
        for name, valid, expected in checks:
            if not valid:
                told = f"--{name.replace('_', '-')} {getattr(self, name)}"
                raise ValueError(f"{told}: it must be {expected}")


@dataclass(frozen=True)
class SequenceFolder:
    """What to make tracks from."""

    name: str
    images: Path  # folder of the images, to which names in the model are relative
    model: Path  # folder of the sparse model
    # A COLMAP database with binary descriptors, which are read in place of the images.
    database: Path | None = None


def find_sequence(
    folder: Path,
    images: Path | None = None,
    model: Path | None = None,
    database: Path | None = None,
) -> SequenceFolder:
    """Find images/ and sparse/ or sparse/0/ in a folder, unless they are given.

    Raises:
        FileNotFoundError: the folder, its images, its model or the database are missing.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder")
    images = images or folder / "images"
    if database is not None:
        if not database.is_file():
            raise FileNotFoundError(f"{database}: no such COLMAP database")
    elif not images.is_dir():
        raise FileNotFoundError(f"{images}: no such folder of images, name it with --images")
    elif not any(images.iterdir()):
        raise FileNotFoundError(f"{images}: the folder of images is empty, name it with --images")
    model = model or colmap.find_model(folder)
    return SequenceFolder(folder.resolve().name, images, model, database)


def provenance(
    sequence: SequenceFolder, options: TracksOptions, model: colmap.ColmapModel | None = None
) -> dict[str, Any]:
    """What the tracks are made from and how, for their `info`: equal for equal tracks.

    The input is a digest of cameras, poses and images.

    Raises:
        FileNotFoundError: the model, or an image that it names, is missing.
        ValueError: the model is broken, or no landmark can be triangulated from its poses.
    """
    model = model or _read_posed_model(sequence.model)
    paths = {name: sequence.images / name for name in model.names}
    for path in paths.values():
        if not path.is_file():
            raise FileNotFoundError(
                f"{path}: the image is missing, but the model {sequence.model} has a pose for it"
            )
    digest = hashlib.sha256(model.cam_from_world.tobytes())
    digest.update(repr((sorted(model.cameras.items()), model.camera_ids.tolist())).encode())
    digest.update(hash_files(paths.items()).encode())
    settings = asdict(options)
    detector = settings.pop("detector")
    made = {"method": _METHOD, "options": settings, "input": digest.hexdigest()}
    return made | ({"detector": detector} if detector else {})


def _read_posed_model(folder: Path) -> colmap.ColmapModel:
    model = colmap.read_model(folder)
    model.check_for_triangulation(folder)
    return model


def extract(
    sequence: SequenceFolder,
    options: TracksOptions,
    threads: int = 1,
    progress: Progress = silent,
) -> Tracks:
    """Make the tracks of a sequence: detect, describe, match, triangulate and complete.

    Images that cannot be read are left out and named in `info`.

    Args:
        sequence: images and model, see `find_sequence`.
        options: how to make the tracks.
        threads: threads for detection and matching; the result is the same.
        progress: called with each stage.

    Raises:
        FileNotFoundError: an image or the model is missing.
        ValueError: the model is broken or does not fit the images, fewer than two images can be
            read, or no landmark can be triangulated.
    """
    given = _read_posed_model(sequence.model)
    made_from = provenance(sequence, options, given)
    given, features, unreadable = _detect(sequence, given, options, threads, progress)
    work = _Matching(*_reduced(given, features, options.max_size), options, threads, progress)
    region, errors = work.look_at_neighbours()
    if options.refine_poses != "yes" and (sentence := misfit(errors)):
        raise ValueError(f"{sequence.model}: {sentence} --refine-poses yes takes them nevertheless")
    error = float(np.median([float(np.median(e)) for e in errors] or [0.0]))
    overlap = work.match_covisible()
    if not any(len(m) for m in work.matches.values()):
        raise _nothing_triangulated(sequence)
    refined = (
        options.refine_poses == "yes" or (options.refine_poses == "auto" and error > _ROUGH_POSES)
    ) and work.refine_poses(error)
    matches = {p: m.where(m.errors <= options.max_error) for p, m in work.matches.items()}
    progress("triangulate", 0, 1)
    keypoints = [f.keypoints for f in work.features]
    reconstruction = triangulation.triangulate(
        work.model, keypoints, matches, options.max_error, options.min_angle
    )
    if not reconstruction.points3D:
        raise _nothing_triangulated(sequence)
    scene = _scene(work, *triangulation.labels_of(reconstruction, keypoints))
    # A descriptor may belong to a landmark if its distance is at most that of 99 % of the matches.
    distances = np.concatenate([m.distances for m in matches.values()])
    max_distance = int(np.percentile(distances, 99)) if len(distances) else 0
    added, merged = _complete(scene, overlap, max_distance, options, progress)
    if not len(scene.positions):
        raise _nothing_triangulated(sequence)
    shift = np.linalg.norm(given.centers - work.model.centers, axis=1)
    info: dict[str, Any] = {
        "sequence": sequence.name,
        **made_from,
        "epipolar_error": round(error, 3),
        "poses_refined": refined,
        "pose_shift_median": float(np.median(shift)),
        "pose_shift_max": float(shift.max()),
        "extent": float(np.linalg.norm(np.ptp(given.centers, axis=0))),
        "static_region": describe(region),
        "images_without_pose": sorted(
            {*given.unposed, *image_names(sequence.images)} - {*given.names, *unreadable}
        ),
        "images_unreadable": unreadable,
        "pairs": len(matches),
        "observations_completed": added,
        "landmarks_merged": merged,
        "max_descriptor_distance": max_distance,
        "software": {
            "opencv": optional("cv2").__version__,
            "protomark": protomark.__version__,
            "pycolmap": colmap.pycolmap.__version__,
        },
    }
    model = replace(work.model, cameras=given.cameras)
    tracks = Tracks.from_features(
        options.descriptor, model, features, scene.labels, scene.positions, info
    )
    if options.max_unlabelled is not None:
        tracks = tracks.where(_labelled_or_strong(tracks, options.max_unlabelled))
    return tracks


def _reduced(
    model: colmap.ColmapModel, features: list[Features], max_size: int
) -> tuple[colmap.ColmapModel, list[Features]]:
    """Cameras and features in the pixels that these were detected at."""
    full = model.cameras
    sizes = {i: reduced_size((c.width, c.height), max_size) for i, c in full.items()}
    scales = {i: (sizes[i][0] / c.width, sizes[i][1] / c.height) for i, c in full.items()}
    cameras = {i: c.resized(*sizes[i]) for i, c in full.items()}
    scaled = [f.scaled(scales[int(i)]) for f, i in zip(features, model.camera_ids, strict=True)]
    return replace(model, cameras=cameras), scaled


@dataclass
class _Matching:
    """Matches between keyframes under poses that may be refined."""

    model: colmap.ColmapModel
    features: list[Features]
    options: TracksOptions
    threads: int
    progress: Progress
    matches: Pairs = field(default_factory=dict)  # of pairs of keyframes (i, j), i < j

    def __post_init__(self) -> None:
        cameras = [self.model.cameras[int(c)] for c in self.model.camera_ids]
        # Undistorted keypoints of each keyframe.
        local = [c.local_rays(f.keypoints) for c, f in zip(cameras, self.features, strict=True)]
        self.rays, self.turns = [rays for rays, _ in local], [turns for _, turns in local]
        self.cameras = cameras
        self.focal = np.array([camera.focal_length for camera in cameras])
        self.views = self._make_views()
        # Rows (k, 2) of the matches of neighbours that agree on a relative pose.
        self.agreeing: dict[tuple[int, int], NDArray[np.int64]] = {}

    def _make_views(self) -> list[View]:
        poses = map(turned, self.model.cam_from_world, self.turns)
        parts = zip(self.features, self.rays, poses, self.focal, strict=True)
        kind = self.options.kind
        return [View(f.descriptors, rays, pose, focal, kind) for f, rays, pose, focal in parts]

    def _match(self, chosen: list[tuple[int, int]], stage: str) -> None:
        def one(pair: tuple[int, int]) -> VerifiedMatches:
            i, j = pair
            return match(self.views[i], self.views[j], self.options.ratio, _ROUGH_ERROR)

        found = parallel_map(one, chosen, self.threads, self.progress, stage)
        self.matches |= dict(zip(chosen, found, strict=True))

    def look_at_neighbours(self) -> tuple[Mask, list[NDArray[np.float64]]]:
        """What never moves in the images, and errors of given poses, see `pose_errors`.

        Keypoints of what never moves get no rays, so that nothing matches them.
        """
        chosen = pairs.neighbour_pairs(len(self.views), _SAMPLE)
        described = [f.descriptors for f in self.features]
        how = self.options.ratio, self.options.kind
        found = parallel_map(
            lambda p: mutual_matches(described[p[0]], described[p[1]], *how),
            chosen,
            self.threads,
            self.progress,
            "judge poses",
        )
        matches = {(i, j): rows for (i, j), rows in zip(chosen, found, strict=True)}
        at = [f.keypoints for f in self.features]
        cameras = self.model.cameras.values()
        size = max(c.width for c in cameras), max(c.height for c in cameras)
        region = static_regions(
            [(at[i][r[:, 0]], at[j][r[:, 1]]) for (i, j), r in matches.items()], size
        )
        for rays, keypoints in zip(self.rays, at, strict=True):
            rays[~outside(region, keypoints)] = np.nan
        for (i, j), rows in matches.items():
            first, second = self._plane_rays(i, rows[:, 0]), self._plane_rays(j, rows[:, 1])
            agree = agreeing(first, second, self._focal(i, j))
            if agree.any():
                self.agreeing[i, j] = rows[agree]
        return region, self._errors()

    def _plane_rays(self, i: int, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Rays (n, 2) of a camera that is not turned."""
        rays = self.rays[i][rows]
        if self.turns[i] is None:
            return rays
        return rays + self.cameras[i].rays(self.features[i].keypoints[rows])

    def _focal(self, i: int, j: int) -> float:
        return float(0.5 * (self.focal[i] + self.focal[j]))

    def _errors(self) -> list[NDArray[np.float64]]:
        errors = []
        for (i, j), rows in self.agreeing.items():
            a, b = rows.T
            poses = pose_at(self.views[i].pose, a), pose_at(self.views[j].pose, b)
            rays = self.rays[i][a], self.rays[j][b]
            errors.append(pose_errors(*poses, *rays, focal=self._focal(i, j)))
        return errors

    def match_covisible(self) -> NDArray[np.float64]:
        """Match keyframes with overlapping views; returns the overlap (m, m)."""
        self._match(pairs.neighbour_pairs(len(self.views)), "match neighbours")
        overlap = pairs.overlaps(self.model, pairs.depth_quartiles(self.views, self.matches))
        chosen = pairs.covisible_pairs(overlap, self.options.partners)
        self._match([p for p in chosen if p not in self.matches], "match covisible")
        return overlap

    def refine_poses(self, error: float) -> bool:
        """Bundle-adjust the poses, and keep the result if clearly more matches fit it.

        Args:
            error: epipolar error of the given poses, pixels.
        """
        given, fitting = (self.model, self.matches), self._fitting()
        keypoints = [f.keypoints for f in self.features]
        for step, limit in enumerate(_REFINE_ERRORS):
            self.progress("refine poses", step, len(_REFINE_ERRORS))
            near = {
                p: m.where((m.errors <= limit) & (m.rows < _REFINE_KEYPOINTS).all(1))
                for p, m in self.matches.items()
            }
            reconstruction = triangulation.triangulate(
                self.model, keypoints, near, limit, self.options.min_angle
            )
            if not reconstruction.points3D:
                break
            self._move(triangulation.refine_poses(given[0], reconstruction, error), self.matches)
        self.progress("refine poses", len(_REFINE_ERRORS), len(_REFINE_ERRORS))
        better = self._fitting() > _CLEARLY_MORE * fitting
        if not better and self.options.refine_poses == "auto":
            self._move(*given)
            return False
        return self.model is not given[0]

    def _move(self, model: colmap.ColmapModel, matches: Pairs) -> None:
        self.model = model
        self.views = self._make_views()
        self.matches = {
            (i, j): with_errors(m, self.views[i], self.views[j]) for (i, j), m in matches.items()
        }

    def _fitting(self) -> float:
        """Number of agreeing matches within a pixel of their epipolar lines."""
        return float(sum((e < 1).sum() for e in self._errors()))


def _scene(work: _Matching, labels: NDArray[np.int64], positions: NDArray[np.float64]) -> Scene:
    counts = np.array([len(f) for f in work.features])
    keyframe = np.repeat(np.arange(len(counts)), counts)
    turns = None
    if any(t is not None for t in work.turns):
        parts = zip(work.turns, counts, strict=True)
        turns = np.concatenate([np.eye(3)[None].repeat(n, 0) if t is None else t for t, n in parts])
    return Scene(
        model=work.model,
        offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        keyframe=keyframe,
        keypoints=np.concatenate([f.keypoints for f in work.features]),
        rays=np.concatenate(work.rays),
        focal=work.focal[keyframe],
        descriptors=np.concatenate([f.descriptors for f in work.features]),
        labels=labels,
        positions=positions,
        turns=turns,
    )


def _complete(
    scene: Scene,
    overlap: NDArray[np.float64],
    max_distance: int,
    options: TracksOptions,
    progress: Progress,
) -> tuple[int, int]:
    """Add missed observations and merge duplicates; returns the numbers of both."""
    completion.clean(scene, options.max_error, options.min_angle, 2)
    partners = [np.flatnonzero(row > pairs.MIN_OVERLAP) for row in overlap]
    added = merged = 0
    for step in range(_COMPLETION_PASSES):
        progress("complete", step, _COMPLETION_PASSES)
        counts = completion.complete(scene, partners, options.max_error, max_distance, options.kind)
        added, merged = added + counts[0], merged + counts[1]
        completion.clean(scene, options.max_error, options.min_angle, 2)
    completion.clean(scene, options.max_error, options.min_angle, options.min_length)
    progress("complete", _COMPLETION_PASSES, _COMPLETION_PASSES)
    return added, merged


def _labelled_or_strong(tracks: Tracks, limit: int) -> NDArray[np.bool_]:
    keep = tracks.landmark_of_keypoint >= 0
    for i in range(len(tracks.keyframe_names)):
        rows = np.arange(tracks.offsets[i], tracks.offsets[i + 1])
        rows = rows[~keep[rows]]
        keep[rows[np.argsort(-tracks.responses[rows], kind="stable")[:limit]]] = True
    return keep


def _nothing_triangulated(sequence: SequenceFolder) -> ValueError:
    return ValueError(
        f"{sequence.name}: no landmark can be triangulated: give images of a moving camera, and "
        "the poses of these images"
    )


def _detect(
    sequence: SequenceFolder,
    model: colmap.ColmapModel,
    options: TracksOptions,
    threads: int,
    progress: Progress,
) -> tuple[colmap.ColmapModel, list[Features], dict[str, str]]:
    """The images that can be read, their features, and what is wrong with each of the others."""
    cv2 = optional("cv2")
    limits = options.max_keypoints, options.max_size
    extractor = Extractor(options.descriptor, *limits, options.detector)

    def one(index: int) -> Features | str:
        path = sequence.images / model.names[index]
        try:
            image = read_gray(path)
            features = extractor(image)
        except ValueError as error:
            return str(error).removeprefix(f"{path}: ")
        camera = model.cameras[int(model.camera_ids[index])]
        if image.shape != (camera.height, camera.width):
            raise ValueError(
                f"{path} has {image.shape[1]}x{image.shape[0]} pixels, but its camera in the model "
                f"{camera.width}x{camera.height}: give the images of this model"
            )
        return features

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        indices = range(len(model.names))
        found = parallel_map(one, indices, threads, progress, "detect and describe")
    finally:
        cv2.setNumThreads(before)
    problems = {n: f for n, f in zip(model.names, found, strict=True) if isinstance(f, str)}
    if len(found) - len(problems) < 2:
        name, problem = next(iter(problems.items()))
        raise ValueError(
            f"{sequence.images}: {len(problems)} of {len(found)} images cannot be read, such as "
            f"{name}: {problem}"
        )
    readable = model.where([isinstance(f, Features) for f in found])
    return readable, [f for f in found if isinstance(f, Features)], problems
