"""A COLMAP database with SIFT and its model, of rendered images, and an encoder."""

from __future__ import annotations

import sqlite3
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.geometry.colmap import new_reconstruction, pycolmap, quiet, read_model
from protomark.match_calibration import MatchCalibration, with_calibration
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


def sift_encoder() -> pm.Encoder:
    """A random projection to 48 numbers, with codebooks and a rough calibration."""
    rng = np.random.default_rng(0)
    weights = np.clip(np.rint(rng.normal(0, 40, (48, 128))), -127, 127).astype(np.int8)
    # RootSIFT's numbers are 40 on average.
    bias = (-40 * weights.sum(1, dtype=np.int64)).astype(np.int32)
    layer = {
        "weights": weights,
        "bias": bias,
        # Sums spread by about 40 * 512 * 0.5.
        "multipliers": np.full(48, round(2**30 * 50 / 12000), np.int32),
        "shift": 30,
        "table": None,
    }
    books: list[NDArray[np.int8]] = [
        rng.integers(-127, 128, (48 // width, 256, width)).astype(np.int8) for width in (1, 2, 4)
    ]
    encoder = pm.Encoder([layer], [16, 48], "sift", "sift", 0.02, codebooks=books, input="uint8")
    fitted = MatchCalibration((-2.0, -1e-4, 3e-4))
    return with_calibration(
        encoder, {(d, tuned): fitted for d in (16, 48) for tuned in (False, True)}, "none"
    )
