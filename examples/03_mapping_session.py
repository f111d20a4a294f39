"""A long mapping session that loses nothing: commit each keyframe, compact now and then.

Runs on the sample that ships: python examples/03_mapping_session.py
Kill it at any moment: opening scene.pmk gives the map as it was committed last, and a next run goes
on with that.
"""

import time
from pathlib import Path

import numpy as np

import protomark as pm
from protomark import sample

tracks = sample.load()
if not Path("scene.pmk").exists():
    pm.PrototypeMap(pm.Encoder.load("freak"), dim=32).save("scene.pmk")

with pm.open("scene.pmk", journal=True) as scene:
    for keyframe in range(len(tracks.keyframe_names)):
        frame = tracks.keypoints_of(keyframe)
        rows = np.arange(frame.start, frame.stop)
        seen = rows[tracks.landmark_of_keypoint[rows] >= 0]
        scene.add(tracks.landmark_of_keypoint[seen], tracks.descriptors[seen])
        begin = time.perf_counter()
        written = scene.commit()
        milliseconds = 1000 * (time.perf_counter() - begin)
        if keyframe % 20 == 0:
            print(f"keyframe {keyframe}: {written:,} bytes in {milliseconds:.1f} ms")
            scene.compact()  # keeps the journal short: opening reads all of it
    scene.compact()

print(pm.open("scene.pmk"), pm.file_journal("scene.pmk"))
