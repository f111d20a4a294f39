"""Map a sequence whose camera is not told.

python benchmarks/mapping_without_camera.py SEQUENCE [FRAMES]

Its first FRAMES images (200), as a folder and as an MPEG-4 video made of them, without the camera;
then the video with the camera. Prints frames registered, focal length, and the trajectory error
(root mean square after the best similarity, in the unit of the true poses).
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from protomark.evaluation.trajectory import trajectory_error
from protomark.localization.absolute_pose import centre
from protomark.mapping.command import Request, make_map
from protomark.mapping.settings import Settings
from protomark.tracks.colmap import find_model, model_of, read_model, read_reconstruction


def main(sequence: Path, count: int) -> None:
    """Make the three maps, one after the other, and print a line for each."""
    true = read_model(find_model(sequence))
    centers = dict(zip(true.names, centre(np.array(true.cam_from_world)), strict=True))
    files = [sequence / "images" / name for name in sorted(true.names)[:count]]
    with tempfile.TemporaryDirectory() as scratch:
        images, video = Path(scratch) / "images", Path(scratch) / "video.mp4"
        images.mkdir()
        frames = [np.asarray(cv2.imread(str(file))) for file in files]
        height, width = frames[0].shape[:2]
        fourcc = cv2.VideoWriter_fourcc(*"mp4v")  # type: ignore[attr-defined]
        writer = cv2.VideoWriter(str(video), fourcc, 10, (width, height))
        for file, frame in zip(files, frames, strict=True):
            shutil.copy(file, images)
            writer.write(frame)
        writer.release()
        known = str(find_model(sequence))
        for label, source, camera in (
            ("images", images, None),
            ("video", video, None),
            ("video, camera known", video, known),
        ):
            scene = Path(scratch) / f"map of {label}"
            figures = make_map(Request(source, scene, Settings(), camera=camera))
            found = model_of(read_reconstruction(scene / "sparse"), scene)
            # A video's frames are named by their place in it.
            names = [
                name if source is images else files[int(name.rsplit("-", 1)[1])].name
                for name in found.names
            ]
            error = trajectory_error(found.centers, np.array([centers[n] for n in names]))
            print(
                f"{label}: {figures['registered']} of {len(files)} frames, focal length "
                f"{figures['camera']['params'][0]:.0f}, error {error.rmse:.3f}"
            )


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 200)
