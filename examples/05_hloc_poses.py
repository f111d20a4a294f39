"""Localize with hloc's pose solver by Protomark's ids: no file of features or of matches is kept.

Runs on the sample that ships: python examples/05_hloc_poses.py
With a model of your own: `protomark tracks kitchen/ -o .`, and its file in place of the sample.
"""

import sys
import zlib  # noqa: F401  (pycolmap breaks it for the whole process if it comes first)
from pathlib import Path

import numpy as np
import pycolmap

import protomark as pm
from protomark import sample
from protomark.exporters import export
from protomark.maps.build import build_map
from protomark.tracks.file import Tracks

if any(word.startswith("-") for word in sys.argv[1:]):
    sys.exit(__doc__)
source = Path(sys.argv[1] if len(sys.argv) > 1 else sample.path())
tracks = Tracks.load(source)

# Each tenth keyframe is a query, all others are the map.
queries = np.arange(len(tracks.keyframe_names))[::10]
in_map = ~np.isin(tracks.keyframe_of_keypoint, queries)
learning = build_map(tracks.where(in_map), pm.Encoder.load(tracks.descriptor))
scene = learning.seal("scene.sealed.pmk", bytes_per_landmark=33)

# hloc's reference model: points have the ids of the map's landmarks.
if not Path("model").exists():
    export(source, Path("model"), "colmap")
reference = pycolmap.Reconstruction("model/sparse/0")

errors = []
with Path("poses.txt").open("w") as poses:  # as hloc writes them
    for query in queries:
        # Of an image: `Extractor("freak")(read_gray(path))` of protomark.features.
        rows = tracks.keypoints_of(query)
        matches = pm.match(scene, tracks.descriptors[rows])
        # From here on it is `QueryLocalizer(reference, config).localize(keypoints,
        # matches.keypoints, matches.landmarks, camera)` of hloc.localize_sfm.
        keypoints = tracks.keypoints[rows][matches.keypoints].astype(float)
        points = np.array([reference.points3D[int(i)].xyz for i in matches.landmarks])
        camera = reference.cameras[int(tracks.keyframe_camera[query])]
        found = pycolmap.estimate_and_refine_absolute_pose(keypoints, points.reshape(-1, 3), camera)
        if found is None:
            continue
        pose = found["cam_from_world"]
        x, y, z, w = pose.rotation.quat
        numbers = " ".join(f"{number:.9g}" for number in (w, x, y, z, *pose.translation))
        poses.write(f"{tracks.keyframe_names[query]} {numbers}\n")
        rotation, translation = np.split(tracks.cam_from_world[query], [3], axis=1)
        center = pose.inverse().translation
        errors.append(np.linalg.norm(center + rotation.T @ translation[:, 0]))

extent = np.linalg.norm(np.ptp(tracks.landmark_positions, axis=0))
print(f"{len(errors)} of {len(queries)} frames localized")
print(f"median error {np.median(errors) / extent:.2%} of the extent of the landmarks")
