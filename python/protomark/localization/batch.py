"""Localizes many images, and writes their poses as a COLMAP model and a table."""

from __future__ import annotations

import csv
import io
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.features.bag import bag_camera, bag_frames, camera_of_size, image_topic, is_bag
from protomark.features.bag_poses import bag_poses
from protomark.features.extractor import MAX_SIZE
from protomark.features.images import file_identity, image_names, read_gray
from protomark.features.video import Decode, is_video, video_frames
from protomark.files import is_utf8, write_text
from protomark.geometry.absolute_pose import FocalLength
from protomark.geometry.camera import Camera
from protomark.geometry.camera_files import CameraSet, camera_from_exif, read_cameras
from protomark.geometry.pose import camera_centers, pose_error
from protomark.geometry.pose_files import (
    PoseSet,
    image_times,
    images_txt,
    poses_of_images,
    tum_trajectory,
)
from protomark.interrupt import deferred_interrupt
from protomark.localization.confidence import MIN_CONFIDENCE
from protomark.localization.localizer import ESTIMATE, Localizer
from protomark.localization.prior import PosePrior
from protomark.localization.shared_camera import check_shared_cameras
from protomark.localization.solve import Localization
from protomark.maps.open import is_map
from protomark.maps.sharded_map import open_scene
from protomark.progress import Progress, silent, tracked
from protomark.threads import map_ahead

POSES, CAMERAS, POINTS, TABLE = "images.txt", "cameras.txt", "points3D.txt", "poses.csv"
TRAJECTORY = "trajectory.txt"
# The table begins with it, by which a later run recognises its own files.
_HEADER = "image,accepted,confidence,inliers,matches"
# Distances in world units (metres if the map is metric) and angles in degrees, as in hloc.
THRESHOLDS = ((0.05, 5.0), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
# True poses are of another world if most believed ones are off by more degrees, or by a larger
# share of their extent.
_OTHER_DEGREES, _OTHER_SHARE, _MIN_JUDGED = 10.0, 0.25, 3
STAGES = ("features", "encode", "search", "pose", "total")


@dataclass(frozen=True)
class LocalizationRequest:
    """What to localize, and how."""

    scene: Path  # a map file, or the folder that `protomark map` wrote
    images: Sequence[Path]  # image files, folders of them, videos, and ROS bags
    every: int = 1  # take every n-th image and frame only
    topic: str | None = None  # of a ROS bag's images; None: the only one with images
    # A cameras.txt, a folder with a COLMAP model, or a camera written out. None: those that the map
    # was made with, for images of their size; "estimate", and for other images: focal lengths come
    # from EXIF data and matches.
    camera: str | None = None
    # Whether focal lengths of given cameras are refined for each image.
    refine_focal_length: bool = False
    # File, folder or topic of a bag, of poses to measure errors against.
    true_poses: Path | None = None
    priors: Path | None = None  # the same of rough poses; None: the whole map is searched
    prior_distance: float = 1.0  # largest error of a prior's position, in world units
    prior_degrees: float = 15.0  # largest error of a prior's orientation
    min_confidence: float = MIN_CONFIDENCE  # smallest probability of an accepted pose
    max_keypoints: int | None = None  # limit on keypoints per image, see `Localizer`
    max_size: int = MAX_SIZE  # larger images are reduced to it before detection
    recall: float | None = None  # see `Localizer`
    threads: int = 1  # number of images to localize at a time


@dataclass(frozen=True)
class ImageResult:
    """The result for one image."""

    name: str  # name of the image
    # Its localization, None if the image cannot be read or has no camera.
    found: Localization | None
    error: str = ""  # what is wrong with the image, else ""
    true_pose: NDArray[np.float64] | None = None  # (3, 4) cam_from_world, if it is known
    time: float | None = None  # of a frame of a video or bag: seconds

    @property
    def true_error(self) -> tuple[float, float] | None:
        """Distance and degrees from the true pose, infinite without one; None if it is unknown."""
        if self.true_pose is None:
            return None
        pose = self.found.cam_from_world if self.found else None
        return (np.inf, np.inf) if pose is None else pose_error(pose, self.true_pose)

    @property
    def confidence(self) -> float:
        """Probability that the pose is right, 0 without a pose."""
        return self.found.confidence if self.found else 0.0

    def as_dict(self) -> dict[str, Any]:
        """The result as JSON values."""
        found = self.found
        pose = found.cam_from_world if found else None
        return {
            "image": self.name,
            "confidence": round(self.confidence, 6),
            "inliers": found.inliers if found else 0,
            "matches": found.evidence.matches if found else 0,
            "place": found.place if found else "",
            "cam_from_world": None if pose is None else pose.tolist(),
            "focal_length": None if pose is None or found is None else found.camera.params[0],
            "position_error": self.true_error[0] if self.true_error else None,
            "angle_error": self.true_error[1] if self.true_error else None,
            "seconds": {k: round(v, 6) for k, v in found.seconds.items()} if found else {},
            "reason": self.error or (found.reason if found else ""),
        }


@dataclass(frozen=True)
class LocalizationBatch:
    """The results for several images."""

    images: Sequence[ImageResult]  # results in the order of the images
    min_confidence: float  # smallest probability of an accepted pose
    interrupted: bool = False  # whether Ctrl-C ended the run early

    def pose(self, image: ImageResult) -> NDArray[np.float64] | None:
        """The pose of an image if it is accepted, else None."""
        if image.found is None or image.found.confidence < self.min_confidence:
            return None
        return image.found.cam_from_world

    def accepted(self, image: ImageResult) -> bool:
        """Whether the pose of an image is likely enough."""
        return self.pose(image) is not None

    def reasons(self) -> dict[str, list[str]]:
        """Each image without an accepted pose, and why, by reasons that differ in numbers only."""
        out: dict[str, list[str]] = {}
        for image in self.images:
            if not self.accepted(image):
                doubt = f"its confidence is only {image.confidence:.2f}"
                told = image.error or (image.found and image.found.reason) or doubt
                kind = re.sub(r"[\d.]+", "#", told.partition(image.name)[2] or told)
                out.setdefault(kind, []).append(f"{image.name}: {told}")
        return out

    def recall(self) -> list[dict[str, float]]:
        """Share of the images with a true pose that are accepted and within each threshold."""
        errors = np.array(
            [
                i.true_error if self.accepted(i) else (np.inf, np.inf)
                for i in self.images
                if i.true_error is not None
            ]
        )
        return [
            {"distance": d, "degrees": a, "recall": float((errors <= (d, a)).all(1).mean())}
            for d, a in (THRESHOLDS if len(errors) else ())
        ]

    def contradiction(self) -> str:
        """A sentence if most believed poses are far from the true ones, else ""."""
        judged = [i for i in self.images if self.accepted(i) and i.true_pose is not None]
        if len(judged) < _MIN_JUDGED:
            return ""
        distance, degrees = np.median([i.true_error for i in judged], axis=0)
        centers = camera_centers(np.array([i.true_pose for i in judged]))
        extent = np.linalg.norm(np.ptp(centers, axis=0))
        if degrees <= _OTHER_DEGREES and distance <= _OTHER_SHARE * extent:
            return ""
        return (
            "the true poses are far from most poses that are believed: are they in the map's world "
            "(origin, axes, scale), as cam_from_world, and under the names of these images?"
        )

    def summary(self) -> dict[str, Any]:
        """Figures over all images."""
        accepted = [i for i in self.images if self.accepted(i)]
        posed = [i for i in self.images if i.found and i.found.cam_from_world is not None]
        timed = [i.found.seconds for i in self.images if i.found]
        errors = np.array([i.true_error for i in accepted if i.true_error is not None])
        inliers = [i.found.inliers for i in accepted if i.found]
        return {
            "images": len(self.images),
            "localized": len(accepted),
            "below_confidence": len(posed) - len(accepted),
            "unreadable": sum(i.found is None for i in self.images),
            "min_confidence": self.min_confidence,
            "median_inliers": float(np.median(inliers)) if accepted else None,
            "median_seconds": {
                stage: float(np.median([s[stage] for s in timed if stage in s]))
                for stage in STAGES
                if any(stage in s for s in timed)
            },
            "with_true_pose": sum(i.true_error is not None for i in self.images),
            "median_position_error": float(np.median(errors[:, 0])) if len(errors) else None,
            "median_angle_error": float(np.median(errors[:, 1])) if len(errors) else None,
            "recall": self.recall(),
        }

    def as_dict(self) -> dict[str, Any]:
        """The summary and each result as JSON values."""
        return {**self.summary(), "each": [i.as_dict() for i in self.images]}

    def write(self, folder: Path) -> None:
        """Write a COLMAP model and a trajectory of accepted poses, and a table of all images."""
        folder.mkdir(parents=True, exist_ok=True)
        camera_lines: dict[str, int] = {}
        poses, camera_ids = {}, {}
        for image in self.images:
            pose = self.pose(image)
            if image.found is None or pose is None:
                continue
            poses[image.name] = pose
            line = str(image.found.camera)
            camera_ids[image.name] = camera_lines.setdefault(line, len(camera_lines) + 1)
        text = "".join(f"{number} {line}\n" for line, number in camera_lines.items())
        write_text(folder / CAMERAS, f"# CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS\n{text}")
        write_text(folder / POSES, images_txt(poses, camera_ids))
        write_text(folder / POINTS, "# The landmarks are in the map\n")
        write_text(folder / TABLE, self.table())
        write_text(folder / TRAJECTORY, tum_trajectory(*self.trajectory()))

    def trajectory(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Times (n,) and cam_from_world (n, 3, 4) of accepted poses.

        Times are those of the frames of one video or bag, else of `image_times`.
        """
        times, _ = image_times([image.name for image in self.images])
        seconds = [i.time for i in self.images if i.time is not None]
        if len(seconds) == len(times) and (np.diff(seconds) > 0).all():
            times = seconds
        found = [(t, self.pose(image)) for t, image in zip(times, self.images, strict=True)]
        posed = [(time, pose) for time, pose in found if pose is not None]
        poses = np.array([pose for _, pose in posed]).reshape(-1, 3, 4)
        return np.array([time for time, _ in posed]), poses

    def table(self) -> str:
        """All images as CSV; a pose is the camera's centre in the world, and its orientation.

        The latter is the rotation from the world to the camera, row by row, as in `images.txt`.
        """
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        header = _HEADER.split(",")
        header += [f"center_{axis}" for axis in "xyz"]
        header += [f"cam_from_world_{i}{j}" for i in range(3) for j in range(3)]
        header += ["focal_length", "position_error", "angle_error"]
        writer.writerow([*header, *(f"seconds_{stage}" for stage in STAGES), "place", "reason"])
        for image in self.images:
            row = image.as_dict()
            pose = image.found.cam_from_world if image.found else None
            numbers = [""] * 12
            if pose is not None:
                numbers = [f"{n:.12g}" for n in (*camera_centers(pose), *pose[:, :3].ravel())]
            writer.writerow(
                [
                    *(row["image"], int(self.accepted(image))),
                    *(row[key] for key in ("confidence", "inliers", "matches")),
                    *numbers,
                    *(row[key] for key in ("focal_length", "position_error", "angle_error")),
                    *(row["seconds"].get(stage, "") for stage in STAGES),
                    row["place"],
                    row["reason"],
                ]
            )
        return out.getvalue()


def _check_folder(output: Path) -> None:
    """Raise FileExistsError if files would be replaced that no earlier run wrote."""
    if is_map(output):
        raise FileExistsError(f"{output} is the folder of a map: name another folder with -o")
    table = output / TABLE
    if table.is_file():
        with table.open("rb") as file:
            if file.read(len(_HEADER)) == _HEADER.encode():
                return
    for name in (POSES, CAMERAS, POINTS, TRAJECTORY, TABLE):
        if (output / name).exists():
            raise FileExistsError(
                f"{output / name} was not written by `protomark localize` and would be replaced: "
                "name another folder with -o"
            )


def localize_files(
    request: LocalizationRequest, output: Path, progress: Progress = silent
) -> LocalizationBatch:
    """Localize images and write their poses; an unreadable image does not end the run.

    Args:
        request: what to localize, and how.
        output: folder for the poses, created if it does not exist.
        progress: called with each image.

    Raises:
        FileNotFoundError, ValueError: the map, a camera or the poses are missing, broken or do not
            fit, or no image can be localized.
        FileExistsError: the folder holds files that no earlier run wrote.
    """
    if not is_map(request.scene) and (maps := [path for path in request.images if is_map(path)]):
        raise ValueError(f"{maps[0]} is a map: name it first, and then the images")
    queries = _list_queries(request.images, request.every, request.topic)
    _check_folder(output)
    scene = open_scene(request.scene)
    if request.recall is not None and not scene.nlist:
        raise ValueError(
            f"--recall {request.recall:g}: {request.scene} has no index: `protomark seal` makes a "
            "map with one by --index yes"
        )
    localizer = Localizer(
        scene,
        max_keypoints=request.max_keypoints,
        max_size=request.max_size,
        recall=request.recall,
    )
    given = request.camera is not None and request.camera != ESTIMATE
    names = [query.name for query in queries]
    cameras = read_cameras(request.camera).for_images(names) if given and request.camera else None
    true_poses, priors = (
        _given_poses(path, queries, request.topic) if path else PoseSet({})
        for path in (request.true_poses, request.priors)
    )

    def localize(query: _Query) -> ImageResult:
        rough = priors.find(query.name, query.time)
        prior = rough is not None and PosePrior(
            rough, request.prior_distance, request.prior_degrees
        )
        found, problem = _localize(localizer, query, cameras, request, prior or None)
        true_pose = true_poses.find(query.name, query.time)
        return ImageResult(query.name, found, problem, true_pose, query.time)

    results: list[ImageResult] = []
    batch = LocalizationBatch(results, request.min_confidence)
    try:
        results_ahead = map_ahead(localize, _with_frames(queries, request.topic), request.threads)
        with deferred_interrupt() as interrupted, closing(results_ahead):
            for result in tracked(results_ahead, progress, "localize", len(queries)):
                results.append(result)
                if interrupted():
                    break
            stopped = interrupted() and len(results) < len(queries)
    except BaseException:
        if any(result.found for result in results):
            results[:] = _with_shared_cameras(results)
            batch.write(output)
        raise
    if not results:
        raise ValueError(f"{queries[0].path}: none of its frames can be read")
    if all(result.found is None for result in results):
        raise ValueError(
            f"none of {len(results)} images is usable; {results[0].name}: {results[0].error}"
        )
    results[:] = _with_shared_cameras(results)
    batch.write(output)
    return replace(batch, interrupted=stopped)


def _with_shared_cameras(results: Sequence[ImageResult]) -> list[ImageResult]:
    checked = iter(check_shared_cameras([result.found for result in results if result.found]))
    return [replace(r, found=next(checked)) if r.found else r for r in results]


@dataclass(frozen=True)
class _Query:
    """An image to localize."""

    name: str
    path: Path  # its file, or the video or bag that it is a frame of
    time: float | None = None  # of a frame: seconds
    camera: Camera | None = None  # of a frame: the bag's
    image: NDArray[np.uint8] | None = None  # of a frame: what it shows


def _list_queries(sources: Sequence[Path], every: int, topic: str | None) -> list[_Query]:
    """Images, and frames that are not decoded yet, in natural order within each source.

    Raises:
        FileNotFoundError: a source is missing, or a folder holds no image.
        ValueError: two images have the same name, or a video or bag does not decode.
    """
    if every < 1:
        raise ValueError(f"--every {every}: it must be at least 1")
    if topic is not None and not any(is_bag(source) for source in sources):
        raise ValueError(f"--topic {topic}: no ROS bag (.bag, .mcap, .db3) is among the images")
    found: dict[str, _Query] = {}
    files: set[object] = set()
    again: list[Path] = []
    for source in sources:
        if source.exists() and is_bag(source):
            camera = bag_camera(source, image_topic(source, topic)[0])
            queries = [
                _Query(name, source, time, camera) for name, time, _ in _frames(source, topic)
            ]
        elif source.is_dir():
            queries = [_Query(name, source / name) for name in image_names(source)]
            if not queries:
                raise FileNotFoundError(f"{source}: this folder holds no image")
        elif not source.is_file():
            raise FileNotFoundError(f"{source}: no such image, folder, video or bag")
        elif is_video(source):
            queries = [_Query(name, source, time) for name, time, _ in video_frames(source)]
        else:
            queries = [_Query(source.name, source)]
        for query in queries:
            if not is_utf8(query.name):
                raise ValueError(f"{query.path}: the name of this image is not UTF-8, rename it")
            file = file_identity(query.path), "" if query.time is None else query.name
            if file in files:
                again.append(query.path)
                continue
            files.add(file)
            if query.name in found:
                raise ValueError(
                    f"{found[query.name].path} and {query.path} have the same name {query.name}: "
                    "localize them apart"
                )
            found[query.name] = query
    if again:
        told = f"{len(again)} images are named twice, such as {again[0]}, and localized once"
        warnings.warn(told, stacklevel=3)
    return list(found.values())[::every]


def _given_poses(path: Path, queries: Sequence[_Query], topic: str | None) -> PoseSet:
    """The poses of images in a file or folder, or on a topic of their bag."""
    names, source = [query.name for query in queries], queries[0].path
    if is_bag(source) and all(query.path == source for query in queries):
        frames = [(query.name, query.time or 0.0) for query in queries]
        given = bag_poses(source, str(path), image_topic(source, topic)[0], frames)
        if given is not None:
            return given
    return poses_of_images(path, names, [query.time for query in queries])


def _frames(path: Path, topic: str | None) -> Iterator[tuple[str, float, Decode]]:
    """The frames of a video or a bag."""
    return bag_frames(path, image_topic(path, topic)[0]) if is_bag(path) else video_frames(path)


def _with_frames(queries: Sequence[_Query], topic: str | None) -> Iterator[_Query]:
    """The queries, with the images of those that are frames of a video or a bag."""
    for path, group in groupby(queries, key=lambda query: query.path):
        asked = {query.name: query for query in group}
        if next(iter(asked.values())).time is None:
            yield from asked.values()
            continue
        for name, _, decode in _frames(path, topic):
            if name in asked:
                yield replace(asked[name], image=decode())


def _localize(
    localizer: Localizer,
    query: _Query,
    cameras: CameraSet | None,
    request: LocalizationRequest,
    prior: PosePrior | None,
) -> tuple[Localization | None, str]:
    """The localization of an image, or what is wrong with it."""
    camera: Camera | None
    focal_length: FocalLength = "rough" if request.refine_focal_length else "known"
    try:
        image = read_gray(query.path) if query.time is None else query.image
        if image is None:
            raise ValueError("this frame does not decode")
        height, width = image.shape
        if cameras is None and query.camera is not None and request.camera is None:
            camera = camera_of_size(query.path, query.camera, width, height)
        elif cameras is None:
            camera = None if request.camera else localizer.map_camera(width, height)
            if camera is None:
                camera = None if query.image is not None else camera_from_exif(query.path)
                focal_length = "rough"
        else:
            camera = cameras.find(query.name, width, height)
        found = localizer.localize(image, camera or ESTIMATE, prior, focal_length=focal_length)
    except (OSError, ValueError) as error:
        return None, str(error)
    return found, ""
