"""How far from a query the landmarks lie that an encoder confuses with its own.

python benchmarks/near_confusions.py ENCODER TRACKS...

Says of the three landmarks nearest to a view by their prototypes, its own left out, what share
projects to within some pixels of the view's keypoint, in its own keyframe. Within 3 pixels they may
be doubles of one point.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import protomark as pm
from protomark.tracks.colmap import project
from protomark.tracks.file import Tracks, sequence_name

QUERIES = 3000
NEAREST = 3
PIXELS = (3, 10)


def shares(encoder: pm.Encoder, tracks: Tracks) -> list[float]:
    """Share of wrong landmarks within each of `PIXELS`."""
    rows = tracks.observations
    landmarks = tracks.landmark_of_keypoint[rows]
    scene = pm.PrototypeMap(encoder)
    scene.add(landmarks, tracks.descriptors[rows])
    drawn = np.random.default_rng(0).choice(len(rows), min(QUERIES, len(rows)), replace=False)
    found, _ = scene.search(tracks.descriptors[rows[drawn]], NEAREST + 1)
    query, column = np.nonzero((found != landmarks[drawn, None]) & (found >= 0))
    wrong = np.searchsorted(tracks.landmark_ids, found[query, column])
    seen = rows[drawn][query]
    keyframe = tracks.keyframe_of_keypoint[seen]
    pose = tracks.cam_from_world[keyframe]
    local = np.einsum("nij,nj->ni", pose[:, :, :3], tracks.landmark_positions[wrong])
    local += pose[:, :, 3]
    pixels = np.full((len(seen), 2), np.inf)
    for camera_id, camera in tracks.cameras.items():
        mine = (tracks.keyframe_camera[keyframe] == camera_id) & (local[:, 2] > 0)
        pixels[mine] = project(camera, local[mine])
    distance = np.linalg.norm(pixels - tracks.keypoints[seen], axis=1)
    return [float((distance < limit).mean()) for limit in PIXELS]


def main() -> None:
    """Print a line a sequence."""
    encoder = pm.Encoder.load(sys.argv[1])
    for path in map(Path, sys.argv[2:]):
        found = shares(encoder, Tracks.load(path))
        texts = [f"{s:.3f} within {p} px" for s, p in zip(found, PIXELS, strict=True)]
        print(f"{sequence_name(path)}: {', '.join(texts)}")


if __name__ == "__main__":
    main()
