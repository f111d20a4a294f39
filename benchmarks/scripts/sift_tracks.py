"""Makes tracks of SIFT's keypoints and matches, so that labels do not favour a binary descriptor.

python benchmarks/scripts/sift_tracks.py OUTPUT SEQUENCE... [--descriptors sift,orb] [--every N]

COLMAP triangulates its matches under the given poses. All descriptors describe the same keypoints,
at SIFT's size and angle. OUTPUT/NAME.db keeps keypoints and matches, which a later run takes up.
"""

import argparse
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from protomark.features.extractor import Extractor, Features
from protomark.features.images import read_gray
from protomark.geometry.colmap import ColmapModel, new_reconstruction, pycolmap, quiet, read_model
from protomark.tracks.database import read_features
from protomark.tracks.extract import find_sequence
from protomark.tracks.file import Tracks
from protomark.tracks.triangulation import labels_of

# All pairs of up to so many images are matched; of more, those up to ten, or a power of two, apart.
EXHAUSTIVE = 130
# The octave of ORB that covers as much as SIFT's size; the factor is OpenCV's for BEBLID's pattern.
SIFT_FACTOR, ORB_PATCH, ORB_SCALE, ORB_LEVELS = 6.75, 31, 1.2, 8


def triangulate(images: Path, model: ColmapModel, database: Path) -> tuple[list[Features], Any]:
    """SIFT of each image, and landmarks as `labels_of` returns them."""
    camera, count = model.cameras[int(model.camera_ids[0])], len(model.names)
    reader, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
    matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    triangulation, single = pycolmap.IncrementalPipelineOptions(), pycolmap.CameraMode.SINGLE
    reader.camera_model, reader.camera_params = camera.model, ",".join(map(repr, camera.params))
    extraction.num_threads = matching.num_threads = triangulation.num_threads = 1
    verification.ransac.random_seed = triangulation.random_seed = 0
    triangulation.extract_colors = False
    # FREAK finds an angle itself, so that a point with two would be two landmarks that look alike.
    extraction.sift.max_num_features, extraction.sift.max_num_orientations = 2000, 1
    match = pycolmap.match_exhaustive if count <= EXHAUSTIVE else pycolmap.match_sequential
    with quiet(), tempfile.TemporaryDirectory() as folder:
        pycolmap.extract_features(database, images, model.names, single, reader, extraction)
        match(database, matching_options=matching, verification_options=verification)
        features = read_features(database, "sift")
        if list(features) != model.names:
            raise SystemExit(f"{database} has other images, or another order of them: remove it")
        points = [f.keypoints for f in features.values()]
        ids, cameras = range(1, count + 1), model.camera_ids.tolist()
        parts = zip(ids, model.names, cameras, points, model.cam_from_world, strict=True)
        given = new_reconstruction(model.cameras, parts)
        made = pycolmap.triangulate_points(given, database, images, folder, options=triangulation)
    return list(features.values()), labels_of(made, points)


def describe(extractor: Extractor, path: Path, f: Features) -> tuple[Features, Any]:
    """The keypoints that the descriptor keeps, and their rows."""
    octaves = np.log(f.sizes * SIFT_FACTOR / ORB_PATCH) / np.log(ORB_SCALE)
    octaves = np.clip(np.rint(octaves), 0, ORB_LEVELS - 1).astype(np.int32)
    sizes = f.sizes * (SIFT_FACTOR if extractor.kind.name in ("beblid", "teblid") else 1)
    values = zip(*(f.keypoints.T - 0.5).tolist(), sizes.tolist(), f.angles.tolist(), strict=True)
    points = [
        cv2.KeyPoint(x, y, size, angle, 0, int(octaves[i]), i)
        for i, (x, y, size, angle) in enumerate(values)
    ]
    kept, descriptors = extractor._compute(read_gray(path), points)
    rows = np.array([point.class_id for point in kept])
    angles = np.array([point.angle for point in kept], np.float32) % 360 % 360
    at = f.keypoints[rows], f.sizes[rows], angles, f.responses[rows], octaves[rows]
    return Features(*at, np.asarray(descriptors, np.uint8)), rows


def main() -> None:
    """Make the files NAME.DESCRIPTOR.safetensors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    parser.add_argument("sequences", type=Path, nargs="+")
    parser.add_argument("--descriptors", default="freak,orb")
    parser.add_argument("--every", type=int, default=1, help="take every so-many-th image")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    for sequence in map(find_sequence, args.sequences):
        model = read_model(sequence.model)
        model = model.where([i % args.every == 0 for i in range(len(model.names))])
        database = args.output / f"{sequence.name}.db"
        features, (labels, positions) = triangulate(sequence.images, model, database)
        of_image = np.split(labels, np.cumsum([len(f) for f in features])[:-1])
        for name in args.descriptors.split(","):
            parts = [(f, np.arange(len(f))) for f in features]
            if name != "sift":
                extractor, paths = Extractor(name), [sequence.images / n for n in model.names]
                parts = [describe(extractor, *one) for one in zip(paths, features, strict=True)]
            label = np.concatenate([of_image[i][rows] for i, (_, rows) in enumerate(parts)])
            count = np.bincount(label[label >= 0], minlength=len(positions))
            keep, number = count >= 3, np.full(len(positions) + 1, -1)
            number[:-1][keep] = np.arange(keep.sum())
            info = {"sequence": sequence.name, "detector": {"name": "SIFT"}, "every": args.every}
            landmarks = number[label], positions[keep]
            tracks = Tracks.from_features(name, model, [f for f, _ in parts], *landmarks, info)
            tracks.save(args.output / f"{sequence.name}.{name}.safetensors")
            mean = f"{count[keep].mean():.1f} observations each"
            print(f"{sequence.name}.{name}: {len(parts)} images, {keep.sum():,} landmarks, {mean}")


if __name__ == "__main__":
    main()
