"""Localizes images in a COLMAP model by COLMAP, and without its database in a map built from it.

python benchmarks/scripts/shrink_colmap.py OUTPUT SEQUENCE...

Every second image of a sequence makes a model: COLMAP's features by its defaults, its matches, and
its points under the poses of the sequence's own model. The other images are then registered in it
as COLMAP's `image_registrator` does, after extraction and matching with all images of the model,
and localized in the map that `protomark build` makes of database and model. OUTPUT keeps what
COLMAP made, which a later run takes up. Times are those of the CPU, on one thread.
"""

from __future__ import annotations

import argparse
import pickle
import shutil
import sqlite3
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.features.extractor import Extractor, described_keypoints
from protomark.features.images import read_gray
from protomark.geometry.camera import Camera
from protomark.geometry.colmap import ColmapModel, new_reconstruction, pycolmap, quiet, read_model
from protomark.geometry.pose import pose_error, transform
from protomark.maps.build import build_map
from protomark.maps.info import matching_bytes
from protomark.maps.origin import map_detector, tracks_metadata
from protomark.maps.seal import SealRequest, observed, seal_map
from protomark.maps.selection import Views
from protomark.maps.sources import read_places
from protomark.tracks.extract import SequenceFolder, find_sequence
from protomark_bench.report import ReportTable

Pose = NDArray[np.float64] | None
RIGHT = 4.0  # pixels between a keypoint and the projection of its nearest landmark


@dataclass(frozen=True)
class Trial:
    """How one program did: poses of the images by name, and seconds of each stage of each image."""

    poses: dict[str, Pose]
    seconds: dict[str, list[float]]

    def errors(self, model: ColmapModel, names: list[str]) -> NDArray[np.float64]:
        """Distances and degrees (n, 2) from the poses of a model."""
        true = dict(zip(model.names, model.cam_from_world, strict=True))
        found = ((name, self.poses[name]) for name in names)
        return np.array([pose_error(pose, true[name]) for name, pose in found if pose is not None])


def extract(database: Path, images: Path, names: list[str], camera: Camera) -> None:
    """COLMAP's features of images."""
    reader, options = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
    reader.camera_model, reader.camera_params = camera.model, ",".join(map(repr, camera.params))
    if database.exists():
        reader.existing_camera_id = 1
    options.num_threads = 1
    single, cpu = pycolmap.CameraMode.SINGLE, pycolmap.Device.cpu
    pycolmap.extract_features(database, images, names, single, reader, options, cpu)


def match(database: Path, pairs: list[tuple[str, str]]) -> None:
    """COLMAP's matches of pairs of images, verified."""
    options, pairing = pycolmap.FeatureMatchingOptions(), pycolmap.ImportedPairingOptions()
    verification = pycolmap.TwoViewGeometryOptions()
    options.num_threads = 1
    verification.ransac.random_seed = 0
    listed = database.with_suffix(".txt")
    listed.write_text("".join(f"{a} {b}\n" for a, b in pairs))
    pairing.match_list_path = listed
    pycolmap.match_image_pairs(database, options, pairing, verification, pycolmap.Device.cpu)


def make_model(folder: Path, images: Path, model: ColmapModel) -> None:
    """The database and the sparse model of a model's images."""
    database = folder / "database.db"
    camera = model.cameras[int(model.camera_ids[0])]
    names = model.names
    extract(database, images, names, camera)
    match(database, [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]])
    points = []
    with quiet(), pycolmap.Database.open(str(database)) as opened:
        for number in range(1, len(names) + 1):
            assert opened.read_image(number).name == names[number - 1]
            points.append(opened.read_keypoints(number)[:, :2])
    parts = zip(
        *(range(1, len(names) + 1), names, model.camera_ids.tolist(), points),
        model.cam_from_world,
        strict=True,
    )
    given = new_reconstruction(model.cameras, parts)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.extract_colors = 1, 0, False
    sparse = folder / "sparse"
    sparse.mkdir()
    pycolmap.triangulate_points(given, database, images, sparse, options=options).write(sparse)


def register(folder: Path, images: Path, names: list[str], queries: list[str]) -> Trial:
    """Register images in the model as `image_registrator` does."""
    database = folder / "queries.db"
    shutil.copy(folder / "database.db", database)
    cameras = pycolmap.Reconstruction(folder / "sparse").cameras
    camera = Camera.from_colmap(next(iter(cameras.values())))
    seconds: dict[str, list[float]] = {"features": [], "match": [], "pose": []}
    for query in queries:
        begin = time.process_time()
        extract(database, images, [query], camera)
        seconds["features"].append(time.process_time() - begin)
        begin = time.process_time()
        match(database, [(query, name) for name in names])
        seconds["match"].append(time.process_time() - begin)
    with pycolmap.Database.open(str(database)) as opened:
        options = pycolmap.DatabaseCacheOptions()
        options.min_num_matches = pycolmap.IncrementalPipelineOptions().min_num_matches
        cache = pycolmap.DatabaseCache.create(opened, options)
    reconstruction = pycolmap.Reconstruction(folder / "sparse")
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(reconstruction)
    settings = pycolmap.IncrementalMapperOptions()
    settings.num_threads, settings.random_seed = 1, 0
    by_name = {image.name: number for number, image in reconstruction.images.items()}
    poses: dict[str, Pose] = {}
    for query in queries:
        begin = time.process_time()
        done = query in by_name and mapper.register_next_image(settings, by_name[query])
        seconds["pose"].append(time.process_time() - begin)
        image = reconstruction.images[by_name[query]] if done else None
        poses[query] = None if image is None else image.cam_from_world().matrix()
    mapper.end_reconstruction(False)
    return Trial(poses, seconds)


def build(folder: Path, encoder: pm.Encoder) -> dict[str, int]:
    """Build a map of a folder's database and model, and seal it; counts and bytes of it."""
    tracks = read_places([folder / "database.db", folder / "sparse"], encoder.descriptor)
    scene = build_map(tracks, encoder, min_observations=1)
    scene.metadata = tracks_metadata(tracks)
    scene.save(folder / "scene.pmk")
    sealed = folder / "scene.sealed.pmk"
    sealed.unlink(missing_ok=True)
    seal_map(scene, sealed, SealRequest(), lambda: Views.of_tracks(tracks), observed(tracks))
    made = pm.open(sealed)
    return {
        "landmarks": len(made),
        "descriptor bytes": round(matching_bytes(made) * len(made)),
        "file bytes": sealed.stat().st_size,
    }


def localize(localizer: pm.Localizer, images: Path, camera: Camera, queries: list[str]) -> Trial:
    """Localize images in the map."""
    poses: dict[str, Pose] = {}
    seconds: dict[str, list[float]] = {"features": [], "match": [], "pose": []}
    for name in queries:
        begin = time.process_time()
        found = localizer.localize(images / name, camera)
        used, wall = time.process_time() - begin, found.seconds
        poses[name] = found.cam_from_world
        for stage, parts in (
            ("features", ["features"]),
            ("match", ["encode", "search"]),
            ("pose", ["pose"]),
        ):
            share = sum(wall.get(part, 0) for part in parts) / wall["total"]
            seconds[stage].append(used * share)
    return Trial(poses, seconds)


def stored_bytes(database: Path) -> int:
    """Bytes of the descriptors in a database."""
    connection = sqlite3.connect(database)
    (count,) = connection.execute("SELECT SUM(LENGTH(data)) FROM descriptors").fetchone()
    connection.close()
    return int(count)


def rows_of(
    name: str,
    folder: Path,
    sequence: SequenceFolder,
    encoder: pm.Encoder,
    every: int,
    options: dict[str, int],
) -> list[list[str]]:
    """A row of the table for each program."""
    model = read_model(sequence.model)
    used = [i % 2 == 0 for i in range(len(model.names))]
    part = model.where(used)
    queries = [name for name, is_used in zip(model.names, used, strict=True) if not is_used][
        ::every
    ]
    camera = model.cameras[int(model.camera_ids[0])]
    trial = folder / "trial.pickle"
    with quiet():
        if not (folder / "sparse" / "points3D.bin").is_file():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            make_model(folder, sequence.images, part)
        if not trial.is_file():
            registered = register(folder, sequence.images, part.names, queries)
            trial.write_bytes(pickle.dumps((registered.poses, registered.seconds)))
    theirs = Trial(*pickle.loads(trial.read_bytes()))
    size = build(folder, encoder)
    localizer = pm.Localizer(folder / "scene.sealed.pmk", **options)
    ours = localize(localizer, sequence.images, camera, queries)
    both = [q for q in queries if theirs.poses[q] is not None and ours.poses[q] is not None]
    lost = sum(theirs.poses[q] is not None and ours.poses[q] is None for q in queries)
    print(f"{name}: {len(part.names)} images in the model, {size}, found by COLMAP only: {lost}")
    bytes_of = [
        (stored_bytes(folder / "database.db"), (folder / "database.db").stat().st_size),
        (size["descriptor bytes"], size["file bytes"]),
    ]
    ratios = ours.errors(model, both) / theirs.errors(model, both)
    ratio = np.exp(np.log(ratios).mean(axis=0))
    print(f"{name}: errors, geometric mean of those by COLMAP's of the same image: {ratio}")
    rows = []
    for program, one, (descriptors, file) in zip(
        ("image_registrator", "Protomark"), (theirs, ours), bytes_of, strict=True
    ):
        found = sum(pose is not None for pose in one.poses.values())
        distance, degrees = np.median(one.errors(model, both), axis=0)
        times = {stage: 1000 * float(np.median(s)) for stage, s in one.seconds.items()}
        rows.append(
            [
                *(name, program, f"{descriptors / 1e6:.2f} MB", f"{file / 1e6:.2f} MB"),
                *(f"{found} of {len(queries)}", f"{distance:.4g}, {degrees:.3g}°"),
                ", ".join(f"{stage} {t:,.0f}" for stage, t in times.items()),
                f"{sum(times.values()):,.0f}",
            ]
        )
    return rows


def extractor_rows(
    name: str, scene: Path, sequence: SequenceFolder, every: int
) -> Iterator[list[str]]:
    """How COLMAP's and OpenCV's SIFT do in the map, one row for each limit on keypoints."""
    model = read_model(sequence.model)
    localizer = pm.Localizer(scene)
    most = described_keypoints(map_detector(localizer.scene))
    queries = range(1, len(model.names), 2)[::every]
    for program, limit in (("COLMAP", most), ("OpenCV", most), ("COLMAP", 2000), ("OpenCV", 2000)):
        extractor = Extractor("sift", limit, detector={"name": program})
        figures = []
        for i in queries:
            camera, pose = model.cameras[int(model.camera_ids[i])], model.cam_from_world[i]
            image = read_gray(sequence.images / model.names[i])
            begin = time.process_time()
            features = extractor(image)
            seconds = time.process_time() - begin
            ids = localizer.scene.search(features.descriptors, k=1)[0][:, 0]
            pixels = camera.project(transform(pose, localizer.scene.positions(ids)))
            right = np.linalg.norm(pixels - features.keypoints, axis=1) <= RIGHT
            found = localizer.localize_features(features.keypoints, features.descriptors, camera)
            error = (np.inf, np.inf)
            if found.cam_from_world is not None:
                error = pose_error(found.cam_from_world, pose)
            figures.append((len(features), right.sum(), *error, 1000 * seconds))
        count, right, distance, degrees, milliseconds = np.median(figures, axis=0)
        yield [
            *(name, program, f"{count:,.0f}", f"{right:,.0f}", f"{right / count:.3f}"),
            *(f"{distance:.4g}, {degrees:.3g}°", f"{milliseconds:,.0f}"),
        ]


def main() -> None:
    """Prints the tables of docs/results/colmap.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    parser.add_argument("sequences", type=Path, nargs="+")
    parser.add_argument("--encoder", default="sift")
    parser.add_argument("--max-keypoints", type=int)
    parser.add_argument("--every", type=int, default=1, help="register every so-many-th image")
    args = parser.parse_args()
    encoder = pm.Encoder.load(args.encoder)
    options: dict[str, Any] = {"max_keypoints": args.max_keypoints} if args.max_keypoints else {}
    rows: list[list[str]] = []
    by_extractor: list[list[str]] = []
    for sequence in map(find_sequence, args.sequences):
        folder = args.output / sequence.name
        rows += rows_of(sequence.name, folder, sequence, encoder, args.every, options)
        scene = folder / "scene.sealed.pmk"
        by_extractor += extractor_rows(sequence.name, scene, sequence, args.every)
    heads = ["sequence", "program", "descriptors", "file", "found", "median error"]
    print(ReportTable([*heads, "milliseconds", "total"], rows).markdown())
    heads = ["sequence", "extractor", "keypoints", "right", "precision", "median error"]
    print(ReportTable([*heads, "milliseconds"], by_extractor).markdown())


if __name__ == "__main__":
    main()
