"""Runs ORB-SLAM3 (pyorbslam3, GPL-3, a program of its own) over rendered RGB-D frames.

python orbslam3_session.py VOCABULARY SAVE LOAD|- START SEED
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT, FOCAL = 480, 360, 400.0
CAMERA = np.array([[FOCAL, 0, 239.5], [0, FOCAL, 179.5], [0, 0, 1]])
PIXELS = 200  # of the plane, per metre
SETTINGS = f"""%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: {FOCAL}
Camera1.fy: {FOCAL}
Camera1.cx: 239.5
Camera1.cy: 179.5
Camera.width: {WIDTH}
Camera.height: {HEIGHT}
Camera.fps: 10
Camera.RGB: 1
RGBD.DepthMapFactor: 1.0
Stereo.ThDepth: 40.0
Stereo.b: 0.0745
ORBextractor.nFeatures: 700
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7
Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -1.8
Viewer.ViewpointF: 500.0
"""


def plane() -> np.ndarray:
    """An image of 12.8 x 9.6 m with corners of all sizes."""
    rng = np.random.default_rng(0)
    shape = (int(9.6 * PIXELS), int(12.8 * PIXELS))
    image = np.zeros(shape)
    for step in (4, 8, 16, 32, 64):
        noise = rng.uniform(-1, 1, (shape[0] // step + 1, shape[1] // step + 1))
        image += cv2.resize(noise, shape[::-1], interpolation=cv2.INTER_NEAREST)
    return np.clip(128 + 40 * image, 0, 255).astype(np.uint8)


def frame(image: np.ndarray, t: float) -> tuple[np.ndarray, np.ndarray]:
    """What a camera sees at a time, and the depth of each pixel."""
    x, y = 6.4 + 2.2 * np.sin(0.5 * t), 4.8 + 1.4 * np.sin(0.8 * t + 0.3)
    z = 3.2 + 0.5 * np.sin(0.6 * t)
    turn = np.array([0.06 * np.sin(t), 0.05 * np.cos(0.7 * t), 0.1 * np.sin(0.4 * t)])
    rotation = cv2.Rodrigues(turn)[0]
    translation = -rotation @ [x, y, -z]
    of_plane = CAMERA @ np.column_stack([rotation[:, :2], translation])
    seen = cv2.warpPerspective(
        image, of_plane @ np.diag([1 / PIXELS, 1 / PIXELS, 1]), (WIDTH, HEIGHT)
    )
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(u - 239.5) / FOCAL, (v - 179.5) / FOCAL, np.ones_like(u)], axis=-1)
    return seen, (z / (rays @ rotation[:, 2])).astype(np.float32)


if __name__ == "__main__":
    import pyorbslam3

    vocabulary, save, load, start, seed = sys.argv[1:]
    settings = SETTINGS + f'System.SaveAtlasToFile: "{save}"\n'
    settings += f'System.LoadAtlasFromFile: "{load}"\n' if load != "-" else ""
    Path(f"{save}.yaml").write_text(settings)
    slam = pyorbslam3.Slam(vocabulary, f"{save}.yaml", pyorbslam3.Sensor.RGBD)
    image, rng = plane(), np.random.default_rng(int(seed))
    tracked = 0
    for i in range(100):
        seen, depth = frame(image, float(start) + 0.05 * i)
        noisy = np.clip(seen + rng.normal(0, 4, seen.shape), 0, 255).astype(np.uint8)
        tracked += slam.track_rgbd(noisy, depth, 0.1 * i).pose_valid
        time.sleep(0.05)  # mapping runs beside
    time.sleep(2)
    slam.shutdown()
    print(f"tracked {tracked} of 100")
