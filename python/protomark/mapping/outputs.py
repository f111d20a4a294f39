"""What a map leaves on disk for others: a map file, a COLMAP model, a trajectory."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import numpy as np

from protomark.files import write_text
from protomark.localization.absolute_pose import centre
from protomark.localization.poses import quaternion_of
from protomark.mapping.memory import Memory, Prototypes
from protomark.mapping.structure import Structure
from protomark.tracks.colmap import pycolmap, quiet

MAP, MODEL, TRAJECTORY = "scene.pmk", "sparse", "trajectory.txt"


def write_map(structure: Structure, memory: Memory, path: Path) -> None:
    """Write prototypes and positions; nothing for memories that are not prototypes."""
    if isinstance(memory, Prototypes):
        ids = memory.map.ids
        memory.map.set_positions(ids, structure.positions[ids])
        memory.map.save(path)


def write_model(structure: Structure, folder: Path) -> None:
    """Write a COLMAP sparse model (binary) whose 3D point ids are the landmark ids."""
    reconstruction = pycolmap.Reconstruction()
    for camera_id in sorted({frame.camera_id for frame in structure.frames}):
        reconstruction.add_camera_with_trivial_rig(
            pycolmap.Camera({**structure.cameras[camera_id].as_dict(), "camera_id": camera_id})
        )
    tracks: dict[int, list[tuple[int, int]]] = {}
    for image_id, frame in enumerate(structure.frames, 1):
        rows = frame.observed
        image = pycolmap.Image(
            name=frame.name,
            camera_id=frame.camera_id,
            image_id=image_id,
            keypoints=frame.keypoints[rows].astype(np.float64).reshape(-1, 2),
        )
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(frame.pose))
        for index, landmark in enumerate(frame.landmarks[rows].tolist()):
            tracks.setdefault(landmark, []).append((image_id, index))
    for landmark in sorted(tracks):
        track = pycolmap.Track([pycolmap.TrackElement(i, k) for i, k in tracks[landmark]])
        reconstruction.add_point3D_with_id(
            landmark, pycolmap.Point3D(xyz=structure.positions[landmark], track=track)
        )
        for image_id, index in tracks[landmark]:
            reconstruction.images[image_id].set_point3D_for_point2D(index, landmark)
    with quiet():
        reconstruction.update_point_3d_errors()
        replace_folder(folder, reconstruction.write)


def replace_folder(folder: Path, write: object) -> None:
    """Let `write` fill a new folder, then put it in the place of `folder`."""
    temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    temporary.chmod(0o755)
    old = folder.with_name(f".{folder.name}.old")
    try:
        write(str(temporary))  # type: ignore[operator]
        if folder.exists():
            shutil.rmtree(old, ignore_errors=True)
            folder.rename(old)
        temporary.rename(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    shutil.rmtree(old, ignore_errors=True)


def write_trajectory(structure: Structure, path: Path) -> None:
    """Write camera poses in the world, in TUM format: time tx ty tz qx qy qz qw."""
    lines = ["# time tx ty tz qx qy qz qw (camera in world)"]
    for frame in sorted(structure.frames, key=lambda f: (f.time, f.name)):
        w, x, y, z = quaternion_of(frame.pose[:, :3].T)
        place = centre(frame.pose)
        numbers = [f"{v + 0.0:.9g}" for v in (*place, x, y, z, w)]
        lines.append(" ".join([f"{frame.time:.6f}", *numbers]))
    write_text(path, "\n".join(lines) + "\n")
