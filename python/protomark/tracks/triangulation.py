"""Triangulates landmarks from matches and poses, and refines poses, by COLMAP."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.bundle import Bundle
from protomark.geometry.colmap import ColmapModel, new_reconstruction, pycolmap, quiet
from protomark.geometry.pose import transform
from protomark.threads import one_blas_thread
from protomark.tracks.matching import VerifiedMatches

_SEED = 0
_REFINE_STEPS = 30


def triangulate(
    model: ColmapModel,  # cameras and m poses
    keypoints: list[NDArray[np.float32]],  # m arrays (n, 2), pixels
    matches: dict[tuple[int, int], VerifiedMatches],  # matches by pairs of keyframes (i, j), i < j
    max_error: float,  # largest reprojection error in pixels
    min_angle: float,  # smallest triangulation angle of a landmark, degrees
) -> Any:
    """Triangulate landmarks from matches under the poses of `model`.

    Returns:
        A `pycolmap.Reconstruction` whose image ids are keyframe indices plus one.
    """
    reconstruction = _posed(model, keypoints)
    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.extract_colors = False
    pipeline.min_num_matches = 1
    # With more threads the order of sums, and so the labels, would vary.
    pipeline.num_threads = 1
    pipeline.random_seed = _SEED
    pipeline.mapper.filter_max_reproj_error = max_error
    pipeline.mapper.filter_min_tri_angle = min_angle
    options = pipeline.triangulation
    options.random_seed = _SEED
    options.min_angle = min_angle
    options.merge_max_reproj_error = options.complete_max_reproj_error = max_error
    # The triangulator limits angles, not pixels; the camera with the widest angle decides.
    focal = min(camera.focal_length for camera in model.cameras.values())
    angle = float(np.degrees(np.arctan(1.5 * max_error / focal)))
    options.create_max_angle_error = options.continue_max_angle_error = angle
    options.re_max_angle_error = 2 * angle
    # Cameras are given, so COLMAP must not reject strong distortion as implausible.
    for bounds in (pipeline, pipeline.mapper, options):
        bounds.min_focal_length_ratio = 1e-12
        bounds.max_focal_length_ratio = bounds.max_extra_param = 1e12
    with quiet(), tempfile.TemporaryDirectory(prefix="protomark-") as folder:
        database = Path(folder) / "matches.db"
        _write_database(database, reconstruction, keypoints, matches)
        return pycolmap.triangulate_points(
            reconstruction, str(database), folder, folder, clear_points=True, options=pipeline
        )


def _posed(model: ColmapModel, keypoints: list[NDArray[np.float32]]) -> Any:
    parts = zip(model.names, model.camera_ids, keypoints, model.cam_from_world, strict=True)
    numbered = [(i, name, int(camera), *rest) for i, (name, camera, *rest) in enumerate(parts, 1)]
    return new_reconstruction(model.cameras, numbered)


def _write_database(
    path: Path,
    reconstruction: Any,
    keypoints: list[NDArray[np.float32]],
    matches: dict[tuple[int, int], VerifiedMatches],
) -> None:
    database = pycolmap.Database.open(str(path))
    try:
        with pycolmap.DatabaseTransaction(database):
            for camera in reconstruction.cameras.values():
                database.write_camera(camera, use_camera_id=True)
            for rig in reconstruction.rigs.values():
                database.write_rig(rig, use_rig_id=True)
            for frame in reconstruction.frames.values():
                database.write_frame(frame, use_frame_id=True)
            for image_id, image in sorted(reconstruction.images.items()):
                database.write_image(image, use_image_id=True)
                database.write_keypoints(image_id, np.asarray(keypoints[image_id - 1], np.float32))
            for (i, j), pair in matches.items():
                if len(pair):
                    geometry = pycolmap.TwoViewGeometry()
                    geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                    geometry.inlier_matches = pair.rows.astype(np.uint32)
                    database.write_two_view_geometry(i + 1, j + 1, geometry)
    finally:
        database.close()


def labels_of(
    reconstruction: Any, keypoints: list[NDArray[np.float32]]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Index (n,) of each keypoint's landmark, -1 for none, and positions (l, 3).

    Of two keypoints in one keyframe, the one with the smaller reprojection error keeps the
    landmark.
    """
    offsets = np.concatenate([[0], np.cumsum([len(k) for k in keypoints])])
    labels = np.full(offsets[-1], -1, np.int64)
    positions = np.zeros((len(reconstruction.points3D), 3))
    for index, point_id in enumerate(sorted(reconstruction.points3D)):
        point = reconstruction.points3D[point_id]
        positions[index] = point.xyz
        best: dict[int, tuple[float, int]] = {}
        for element in point.track.elements:
            i, row = element.image_id, element.point2D_idx
            if i in best:
                seen = reconstruction.images[i].project_point(point.xyz)
                error = [float(np.hypot(*(seen - keypoints[i - 1][r]))) for r in (row, best[i][1])]
                if (error[1], best[i][1]) <= (error[0], row):
                    continue
            best[i] = (0.0, row)
        for i, (_, row) in best.items():
            labels[offsets[i - 1] + row] = index
    return labels, positions


def refine_poses(given: ColmapModel, reconstruction: Any, error: float) -> ColmapModel:
    """Adjust poses and points (not cameras) robustly against wrong matches.

    The given positions are priors, as uncertain as the error makes them, and the result stays in
    their world: its scale, rotation and origin bring the refined cameras closest to the given ones.
    """
    images = [reconstruction.images[i + 1] for i in range(len(given.names))]
    elements = [
        (i, point.point3D_id, *point.xy)
        for i, image in enumerate(images)
        for point in image.points2D
        if point.has_point3D()
    ]
    frame, ids = np.array([row[:2] for row in elements], np.int64).T
    pixels = np.array([row[2:] for row in elements])
    used, point = np.unique(ids, return_inverse=True)
    cameras = sorted(given.cameras)
    camera = np.searchsorted(cameras, given.camera_ids)
    focal = np.array([given.cameras[i].focal_length for i in cameras])
    rays, turns = np.empty_like(pixels), np.tile(np.eye(3), (len(pixels), 1, 1))
    for k, i in enumerate(cameras):
        rows = camera[frame] == k
        rays[rows], turned = given.cameras[i].local_rays(pixels[rows])
        if turned is not None:
            turns[rows] = turned
    seen = np.isfinite(rays).all(1)
    frame, point, rays, turns = frame[seen], point[seen], rays[seen], turns[seen]
    poses = np.array([image.cam_from_world().matrix() for image in images])
    points = np.array([reconstruction.points3D[i].xyz for i in used.tolist()])
    depths = transform(poses[frame], points[point])[:, 2]
    bundle = Bundle(
        poses,
        np.ones(len(poses), bool),
        camera,
        np.column_stack([focal, np.zeros(len(focal))]),
        np.zeros(len(focal), bool),
        points,
        frame,
        point,
        rays * focal[camera[frame], None],
        np.ones(len(frame)),
        turns,
        given.centers,
        error / focal.min() * float(np.median(depths)),
    )
    with one_blas_thread():
        bundle.adjust(_REFINE_STEPS)
    return replace(given, cam_from_world=bundle.poses)
