"""From an image folder with a COLMAP sparse model to tracks."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from protomark.tracks.features import Extractor, Features, descriptor_kind, read_gray
from protomark.tracks.file import Tracks

S = TypeVar("S")
T = TypeVar("T")
# Called with a stage's name, steps done and steps in all.
Progress = Callable[[str, int, int], None]

# Matches are kept this far (pixels) from the epipolar line until it is known how good poses are.
_ROUGH_ERROR = 16.0
# Poses with a larger epipolar error (pixels, median over pairs of each pair's median) are refined
# under `refine_poses="auto"`. Structure from motion shows 0.2 to 0.7, rough poses 1.3 and more.
_ROUGH_POSES = 1.0
_MIN_MATCHES = 15
_REFINE_ERRORS = (12.0, 4.0)
# Keypoints of an image, the strongest, that take part in refinement; more cost time, not error.
_REFINE_KEYPOINTS = 700
_PASSES = 3
# Goes up whenever the same settings give other tracks, so that old files are made anew.
_METHOD = 3


@dataclass(frozen=True)
class Settings:
    """How tracks are made. A file made with other settings is made anew.

    Attributes:
        descriptor: name of the descriptor, see `protomark.tracks.features.DESCRIPTORS`.
        max_keypoints: keypoints kept in an image.
        partners: about how many keyframes each keyframe is matched with.
        ratio: ratio test, nearest to second nearest Hamming distance.
        max_error: largest epipolar and reprojection error, pixels.
        min_angle: smallest angle between two rays of a landmark, degrees.
        min_length: fewest observations of a landmark.
        refine_poses: "yes", "no", or "auto": where matches say that poses are only roughly right.
        max_unlabelled: keypoints without a landmark that a keyframe keeps, the strongest; None
            keeps all. Fewer make smaller files, but a query frame then shows fewer of the
            keypoints that match nothing.
    """

    descriptor: str = "freak"
    max_keypoints: int = 2000
    partners: int = 24
    ratio: float = 0.8
    max_error: float = 3.0
    min_angle: float = 1.0
    min_length: int = 3
    refine_poses: str = "auto"
    max_unlabelled: int | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "descriptor", descriptor_kind(self.descriptor).name)
        checks = (
            ("max_keypoints", self.max_keypoints >= 2, "at least 2"),
            ("partners", self.partners >= 1, "at least 1"),
            ("ratio", 0 < self.ratio <= 1, "in (0, 1]"),
            ("max_error", 0 < self.max_error <= _ROUGH_ERROR, f"in (0, {_ROUGH_ERROR:g}]"),
            ("min_angle", 0 <= self.min_angle < 90, "in [0, 90)"),
            ("min_length", self.min_length >= 2, "at least 2"),
            (
                "max_unlabelled",
                self.max_unlabelled is None or self.max_unlabelled >= 0,
                "at least 0",
            ),
            ("refine_poses", self.refine_poses in ("auto", "yes", "no"), "auto, yes or no"),
        )
        for name, fine, want in checks:
            if not fine:
                raise ValueError(f"{name} is {getattr(self, name)}, it must be {want}")


@dataclass(frozen=True)
class Source:
    """Where a sequence lies.

    Attributes:
        name: the sequence's name, used for the output file.
        images: folder of the images; names in the model are relative to it.
        model: folder of the sparse model.
    """

    name: str
    images: Path
    model: Path


def find_source(folder: Path, images: Path | None = None, model: Path | None = None) -> Source:
    """Find images/ and sparse/ or sparse/0/ in a folder, unless told otherwise.

    Raises:
        FileNotFoundError: the folder, its images or its model are missing.
    """
    from protomark.tracks.colmap import find_model

    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder")
    images = images or folder / "images"
    if not images.is_dir():
        raise FileNotFoundError(f"{images}: no such folder of images, name it with --images")
    if not any(file.is_file() for file in images.rglob("*")):
        raise FileNotFoundError(f"{images}: the folder is empty, it should hold the images")
    return Source(folder.resolve().name, images, model or find_model(folder))


def fingerprint(source: Source) -> str:
    """Digest of what the tracks are made from: cameras, poses, image names and file sizes.

    Raises:
        FileNotFoundError: an image that the model names is missing.
        ValueError: the model is broken or holds too little.
    """
    from protomark.tracks.colmap import read_model

    model = read_model(source.model)
    digest = hashlib.sha256(model.cam_from_world.tobytes())
    digest.update(repr((sorted(model.cameras.items()), model.camera_ids.tolist())).encode())
    for name in model.names:
        path = source.images / name
        if not path.is_file():
            raise FileNotFoundError(
                f"{path}: image is missing, though the model {source.model} has a pose for it"
            )
        digest.update(f"{name}\0{path.stat().st_size}\0".encode())
    return digest.hexdigest()


def is_done(path: Path, settings: Settings, digest: str) -> bool:
    """Whether `path` holds tracks made with these settings from this very input."""
    if not path.is_file():
        return False
    try:
        info = Tracks.load(path).info
    except (ValueError, OSError):
        return False
    try:
        # Options that came after the file was made have their defaults.
        made_with = Settings(**info.get("settings", {}))
    except (TypeError, ValueError):
        return False
    if info.get("method") != _METHOD:
        return False
    return made_with == settings and info.get("input") == digest


def extract(
    source: Source,
    settings: Settings,
    threads: int = 1,
    progress: Progress = lambda stage, done, total: None,
) -> Tracks:
    """Detect, describe, match, triangulate and complete: the tracks of one sequence.

    Args:
        source: images and model, see `find_source`.
        settings: how to make them.
        threads: threads for detection and matching; the result is the same.
        progress: called with each stage's name, steps done and steps in all.

    Raises:
        FileNotFoundError: an image or the model is missing.
        ValueError: a broken image or model, or nothing could be triangulated.
    """
    from protomark.tracks import colmap, completion, pairs, triangulation
    from protomark.tracks.matching import Matches, View, match
    from protomark.tracks.scene import Scene

    digest = fingerprint(source)
    model = colmap.read_model(source.model)
    features = _detect(source, model, settings, threads, progress)
    keypoints = [f.keypoints for f in features]
    focal = {k: colmap.focal_length(c) for k, c in model.cameras.items()}

    def views_of(model: colmap.Model) -> list[View]:
        return [
            View(f.descriptors, ray, pose, focal[int(c)])
            for f, ray, pose, c in zip(
                features, all_rays, model.cam_from_world, model.camera_ids, strict=True
            )
        ]

    all_rays = [
        colmap.rays(model.cameras[int(c)], k)
        for c, k in zip(model.camera_ids, keypoints, strict=True)
    ]
    views = views_of(model)

    def match_all(chosen: list[tuple[int, int]], stage: str) -> dict[tuple[int, int], Matches]:
        found = _parallel(
            lambda ij: match(views[ij[0]], views[ij[1]], settings.ratio, _ROUGH_ERROR),
            chosen,
            threads,
            lambda done: progress(stage, done, len(chosen)),
        )
        return dict(zip(chosen, found, strict=True))

    matches = match_all(pairs.neighbour_pairs(len(views)), "match neighbours")
    overlap = pairs.overlaps(model, pairs.depth_quartiles(views, matches))
    chosen = pairs.covisible_pairs(overlap, settings.partners)
    matches |= match_all([p for p in chosen if p not in matches], "match covisible")
    if not any(len(m) for m in matches.values()):
        raise _nothing(source)
    error = _pose_error(matches)
    refine = settings.refine_poses == "yes" or (
        settings.refine_poses == "auto" and error > _ROUGH_POSES
    )
    given = model
    if refine:
        for step, limit in enumerate(_REFINE_ERRORS):
            progress("refine poses", step, len(_REFINE_ERRORS))
            near = {
                p: m.where((m.errors <= limit) & (m.rows < _REFINE_KEYPOINTS).all(1))
                for p, m in matches.items()
            }
            reconstruction = triangulation.triangulate(
                model, keypoints, near, limit, settings.min_angle
            )
            if not reconstruction.points3D:
                raise _nothing(source)
            model = triangulation.refine_poses(model, reconstruction)
            views = views_of(model)
            matches = {p: _with_errors(m, views[p[0]], views[p[1]]) for p, m in matches.items()}
        progress("refine poses", len(_REFINE_ERRORS), len(_REFINE_ERRORS))

    matches = {p: m.where(m.errors <= settings.max_error) for p, m in matches.items()}
    progress("triangulate", 0, 1)
    reconstruction = triangulation.triangulate(
        model, keypoints, matches, settings.max_error, settings.min_angle
    )
    if not reconstruction.points3D:
        raise _nothing(source)
    labels, positions = triangulation.labels_of(reconstruction, keypoints)
    progress("triangulate", 1, 1)

    counts = np.array([len(k) for k in keypoints])
    keyframe = np.repeat(np.arange(len(counts)), counts)
    scene = Scene(
        model=model,
        offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        keyframe=keyframe,
        keypoints=np.concatenate(keypoints),
        rays=np.concatenate(all_rays),
        focal=np.array([focal[int(c)] for c in model.camera_ids])[keyframe],
        descriptors=np.concatenate([f.descriptors for f in features]),
        labels=labels,
        positions=positions,
    )
    completion.clean(scene, settings.max_error, settings.min_angle, 2)
    # A descriptor agrees with a landmark's if nearly all verified matches are no closer.
    distances = np.concatenate([m.distances for m in matches.values()])
    max_distance = int(np.percentile(distances, 99)) if len(distances) else 0
    partners = [np.flatnonzero(overlap[i] > pairs.MIN_OVERLAP) for i in range(len(views))]
    added = merged = 0
    for step in range(_PASSES):
        progress("complete", step, _PASSES)
        more, joined = completion.complete(scene, partners, settings.max_error, max_distance)
        added, merged = added + more, merged + joined
        completion.clean(scene, settings.max_error, settings.min_angle, 2)
    completion.clean(scene, settings.max_error, settings.min_angle, settings.min_length)
    progress("complete", _PASSES, _PASSES)
    if not len(scene.positions):
        raise _nothing(source)
    info: dict[str, Any] = {
        "sequence": source.name,
        "method": _METHOD,
        "settings": asdict(settings),
        "input": digest,
        "epipolar_error": round(error, 3),
        "poses_refined": refine,
        "pose_shift_median": float(
            np.median(np.linalg.norm(given.centers - model.centers, axis=1))
        ),
        "images_without_pose": sorted(
            {*model.unposed, *_image_files(source.images)} - set(model.names)
        ),
        "pairs": len(matches),
        "observations_completed": added,
        "landmarks_merged": merged,
        "max_descriptor_distance": max_distance,
        "software": _versions(),
    }
    tracks = tracks_of(scene, features, settings.descriptor, info)
    if settings.max_unlabelled is not None:
        tracks = tracks.where(_labelled_or_strong(tracks, settings.max_unlabelled))
    return tracks


def _labelled_or_strong(tracks: Tracks, limit: int) -> NDArray[np.bool_]:
    keep = tracks.landmark_of_keypoint >= 0
    for i in range(len(tracks.keyframe_names)):
        rows = np.arange(tracks.offsets[i], tracks.offsets[i + 1])
        rows = rows[~keep[rows]]
        keep[rows[np.argsort(-tracks.responses[rows], kind="stable")[:limit]]] = True
    return keep


def _nothing(source: Source) -> ValueError:
    return ValueError(
        f"{source.name}: no landmark could be triangulated; "
        "do images and poses belong together, and does the camera move?"
    )


def tracks_of(
    scene: Any, features: list[Features], descriptor: str, info: dict[str, Any]
) -> Tracks:
    """Put a labelled scene and its features into a Tracks."""
    model = scene.model
    tracks = Tracks(
        descriptor=descriptor,
        cameras=model.cameras,
        keyframe_names=model.names,
        keyframe_camera=model.camera_ids,
        cam_from_world=np.ascontiguousarray(model.cam_from_world),
        offsets=scene.offsets,
        keypoints=scene.keypoints,
        sizes=np.concatenate([f.sizes for f in features]),
        angles=np.concatenate([f.angles for f in features]),
        responses=np.concatenate([f.responses for f in features]),
        octaves=np.concatenate([f.octaves for f in features]),
        descriptors=scene.descriptors,
        landmark_of_keypoint=scene.labels,
        landmark_ids=np.arange(len(scene.positions), dtype=np.int64),
        landmark_positions=scene.positions,
        info=info,
    )
    tracks.check()
    return tracks


def _detect(
    source: Source, model: Any, settings: Settings, threads: int, progress: Progress
) -> list[Features]:
    import cv2

    # One extractor a thread: OpenCV's are costly to make and not to be shared.
    local = threading.local()

    def one(index: int) -> Features:
        if not hasattr(local, "extractor"):
            local.extractor = Extractor(settings.descriptor, settings.max_keypoints)
        name = model.names[index]
        image = read_gray(source.images / name)
        camera = model.cameras[int(model.camera_ids[index])]
        if image.shape != (camera.height, camera.width):
            raise ValueError(
                f"{source.images / name}: {image.shape[1]}x{image.shape[0]} pixels, but its camera "
                f"in the model has {camera.width}x{camera.height}; use the images of this model"
            )
        features: Features = local.extractor(image)
        return features

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        return _parallel(
            one,
            range(len(model.names)),
            threads,
            lambda done: progress("detect and describe", done, len(model.names)),
        )
    finally:
        cv2.setNumThreads(before)


def _pose_error(matches: dict[tuple[int, int], Any]) -> float:
    """Epipolar error of a typical pair: each pair counts once, so near pairs do not outvote far."""
    medians = [float(np.median(m.errors)) for m in matches.values() if len(m) >= _MIN_MATCHES]
    return float(np.median(medians)) if medians else 0.0


def _with_errors(matches: Any, first: Any, second: Any) -> Any:
    from protomark.tracks.geometry import epipolar_error, relative_pose

    rotation, translation = relative_pose(first.pose, second.pose)
    errors = epipolar_error(
        rotation, translation, first.rays[matches.rows[:, 0]], second.rays[matches.rows[:, 1]]
    )
    return replace(matches, errors=errors * 0.5 * (first.focal + second.focal))


def _parallel(
    function: Callable[[S], T], items: Iterable[S], threads: int, done: Callable[[int], None]
) -> list[T]:
    """Map in order, on several threads if asked; OpenCV and the core release the GIL."""
    results = []
    if threads <= 1:
        for item in items:
            results.append(function(item))
            done(len(results))
        return results
    with ThreadPoolExecutor(threads) as pool:
        futures = [pool.submit(function, item) for item in items]
        try:
            for future in futures:
                results.append(future.result())
                done(len(results))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return results


def _image_files(folder: Path) -> list[str]:
    suffixes = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".ppm", ".pgm", ".webp"}
    return [
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.suffix.lower() in suffixes
    ]


def _versions() -> dict[str, str]:
    from importlib.metadata import PackageNotFoundError, version

    import cv2

    found = {"opencv": cv2.__version__}
    for package in ("protomark", "pycolmap"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
