"""Records a map in the making for the Rerun viewer: camera, frame with its matches, landmarks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from protomark.extras import optional
from protomark.geometry.pose import camera_centers
from protomark.mapping.frame import InputImage
from protomark.mapping.mapper import Mapper

# The whole map is recorded only once in this many frames, to keep the recording small.
_MAP_EVERY = 5
_MAX_OBSERVATIONS = 20


class Recording:
    """Writes the .rrd file `path` while a map is made."""

    def __init__(self, path: Path) -> None:
        self._rr = rerun = optional("rerun")
        self._recording = rerun.RecordingStream("protomark map")
        self._recording.save(str(path))
        self._recording.log("world", rerun.ViewCoordinates.RDF, static=True)
        self._count = 0

    def show(self, mapper: Mapper, image: InputImage) -> None:
        """Record a frame and what it adds to the map."""
        rr, recording = self._rr, self._recording
        recording.set_time("frame", sequence=self._count)
        self._count += 1
        structure = mapper.structure
        frame = structure.frames[-1] if structure.frames else None
        if frame is not None and frame.name == image.name:
            camera = structure.cameras[frame.camera_id]
            pose = frame.pose
            recording.log(
                "world/camera",
                rr.Transform3D(translation=camera_centers(pose), mat3x3=pose[:, :3].T),
                rr.Pinhole(
                    focal_length=camera.focal_length,
                    width=camera.width,
                    height=camera.height,
                    image_plane_distance=0.3,
                ),
            )
            if image.image is not None:
                recording.log("world/camera/image", rr.Image(image.image).compress(70))
            recording.log(
                "world/camera/image/matches",
                rr.Points2D(frame.keypoints[frame.observed], colors=[15, 200, 160], radii=2),
            )
        if structure.frames and self._count % _MAP_EVERY == 1:
            self._map(mapper)

    def _map(self, mapper: Mapper) -> None:
        rr, structure = self._rr, mapper.structure
        ids = structure.ids
        counts = structure.counts(keyframes_only=False)[ids]
        self._recording.log(
            "world/landmarks", rr.Points3D(structure.positions[ids], colors=_colours(counts))
        )
        path = camera_centers(np.array([f.pose for f in structure.frames]))
        self._recording.log("world/path", rr.LineStrips3D([path], colors=[220, 38, 38]))

    def close(self) -> None:
        """Write the rest of the recording."""
        self._recording.flush()
        self._recording.disconnect()


def _colours(counts: Any) -> Any:
    """Colours (n, 3) uint8 from violet (two observations) to yellow (many)."""
    colormaps = optional("matplotlib").colormaps
    share = np.clip((counts - 2) / (_MAX_OBSERVATIONS - 2), 0, 1)
    return (255 * colormaps["viridis"](share)[:, :3]).astype(np.uint8)
