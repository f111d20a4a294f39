"""A COLMAP database with SIFT and its model, of rendered images."""

from __future__ import annotations

import sqlite3
import tempfile
from pathlib import Path

from protomark.geometry.colmap import new_reconstruction, pycolmap, quiet, read_model
from tracks_scene import write_sequence


def write_sift_scene(folder: Path, count: int = 6) -> Path:
    """A folder with images/, sparse/, database.db by COLMAP, and points/, triangulated from it."""
    write_sequence(folder, count=count)
    model = read_model(folder / "sparse")
    database, images = folder / "database.db", folder / "images"
    extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
    verification, triangulation = (
        pycolmap.TwoViewGeometryOptions(),
        pycolmap.IncrementalPipelineOptions(),
    )
    extraction.sift.max_num_features = 600
    extraction.num_threads = matching.num_threads = triangulation.num_threads = 1
    verification.ransac.random_seed = triangulation.random_seed = 0
    triangulation.extract_colors = False
    camera = model.cameras[1]
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model, reader.camera_params = camera.model, ",".join(map(repr, camera.params))
    cpu, single = pycolmap.Device.cpu, pycolmap.CameraMode.SINGLE
    with quiet(), tempfile.TemporaryDirectory() as temporary:
        pycolmap.extract_features(database, images, model.names, single, reader, extraction, cpu)
        pycolmap.match_exhaustive(
            database, matching_options=matching, verification_options=verification, device=cpu
        )
        keypoints = {}
        with pycolmap.Database.open(str(database)) as opened:
            for image in opened.read_all_images():
                keypoints[image.name] = image.image_id, opened.read_keypoints(image.image_id)
        parts = [
            (keypoints[name][0], name, 1, keypoints[name][1][:, :2], pose)
            for name, pose in zip(model.names, model.cam_from_world, strict=True)
        ]
        given = new_reconstruction(model.cameras, parts)
        made = pycolmap.triangulate_points(
            given, database, images, temporary, options=triangulation
        )
    (folder / "points").mkdir()
    made.write(str(folder / "points"))
    connection = sqlite3.connect(database)
    connection.execute("PRAGMA journal_mode = DELETE")
    connection.close()
    return folder
