"""Build a map from observations, search it with a new frame, let it learn, save and seal it.

Runs on the sample that ships: python examples/01_map_and_search.py
"""

import numpy as np

import protomark as pm
from protomark import sample
from protomark.maps.info import matching_bytes

tracks = sample.load()
encoder = pm.Encoder.load("freak")

# One keyframe is the new frame, all others are the map.
frame = tracks.keypoints_of(40)
seen = np.setdiff1d(tracks.observations, np.arange(frame.start, frame.stop))

# 48 of the encoder's 64 numbers; appearances whose codes differ in one of 10 signs are kept apart.
scene = pm.PrototypeMap(encoder, dim=48, appearance_bits=10)
scene.add(tracks.landmark_of_keypoint[seen], tracks.descriptors[seen])
print(scene)

# Nearest landmark of each keypoint, kept where it is clearly nearer than the second nearest.
ids, distances = scene.search(tracks.descriptors[frame], k=2, ratio=0.9)
matched = np.flatnonzero(ids[:, 0] >= 0)
truth = tracks.landmark_of_keypoint[frame]
right = ids[matched, 0] == truth[matched]
print(f"{len(matched)} of {len(truth)} keypoints matched, {right.sum()} surely right")

# The frame's right matches update their prototypes; the descriptors are not needed any more.
scene.add(ids[matched, 0][right], tracks.descriptors[frame][matched][right])

scene.metadata = {"frame": "COLMAP, no scale", "source": "sample"}
scene.save("scene.pmk")
# Prototypes become words, and appearances are merged until a landmark takes 33 bytes on average.
sealed = scene.seal("scene.sealed.pmk", bytes_per_landmark=33)
print(sealed, f"{matching_bytes(sealed):.0f} bytes per landmark")
