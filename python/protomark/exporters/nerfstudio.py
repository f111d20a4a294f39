"""Writes nerfstudio's transforms.json, with the landmarks as a point cloud to start splats from.

The fields are those of nerfstudio's documentation (Apache-2.0), "Data conventions": poses are
camera to world, with x right, y up and z backward in the camera.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from protomark.exporters.colmap import coloured_points
from protomark.exporters.ply import write_ply
from protomark.files import replacing_folder
from protomark.geometry.camera import Camera
from protomark.geometry.colmap import model_from_reconstruction

# COLMAP's models that nerfstudio has, with the names of the parameters after the principal point.
_MODELS = {
    "SIMPLE_PINHOLE": ("OPENCV", ()),
    "PINHOLE": ("OPENCV", ()),
    "SIMPLE_RADIAL": ("OPENCV", ("k1",)),
    "RADIAL": ("OPENCV", ("k1", "k2")),
    "OPENCV": ("OPENCV", ("k1", "k2", "p1", "p2")),
    "OPENCV_FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
    "SIMPLE_RADIAL_FISHEYE": ("OPENCV_FISHEYE", ("k1",)),
    "RADIAL_FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2")),
}


def write_nerfstudio(reconstruction: Any, output: Path, images: Path | None) -> dict[str, Any]:
    """Write transforms.json and points.ply to a folder.

    Images are named in `images`, or in images/ beside transforms.json.

    Raises:
        ValueError: nerfstudio has no such camera, or not both kinds in one scene.
    """
    model = model_from_reconstruction(reconstruction, output)
    folder_of_images = "images" if images is None else images.resolve().as_posix()
    flip = np.diag([1.0, -1, -1, 1])
    frames = []
    for name, camera_id, pose in zip(
        model.names, model.camera_ids.tolist(), model.cam_from_world, strict=True
    ):
        world_from_cam = np.linalg.inv(np.vstack([pose, [0, 0, 0, 1]])) @ flip
        frames.append(
            {
                "file_path": f"{folder_of_images}/{name}",
                "transform_matrix": world_from_cam.tolist(),
                **_intrinsics(model.cameras[camera_id]),
            }
        )
    if len({frame["camera_model"] for frame in frames}) > 1:
        raise ValueError(
            "nerfstudio takes all cameras for fisheyes or none, and this scene has both: export "
            "the images of each on their own"
        )
    # Fields of all frames stand once if they have one camera.
    shared = _intrinsics(model.cameras[int(model.camera_ids[0])]) if frames else {}
    if all(frame.items() >= shared.items() for frame in frames):
        frames = [{k: v for k, v in frame.items() if k not in shared} for frame in frames]
    else:
        shared = {"camera_model": shared["camera_model"]}
    output.parent.mkdir(parents=True, exist_ok=True)
    positions, counts, colours = coloured_points(reconstruction)
    if images is None:
        colours = np.full_like(colours, 128)
    with replacing_folder(output) as folder:
        write_ply(folder / "points.ply", positions, counts, colours)
        facts = {**shared, "ply_file_path": "points.ply", "frames": frames}
        (folder / "transforms.json").write_text(json.dumps(facts, indent=1) + "\n")
    return {"images": len(frames), "cameras": len(model.cameras), "landmarks": len(positions)}


def _intrinsics(camera: Camera) -> dict[str, Any]:
    if camera.model not in _MODELS:
        raise ValueError(
            f"nerfstudio has no camera {camera.model}: undistort the images first "
            "(`colmap image_undistorter`)"
        )
    model, names = _MODELS[camera.model]
    params = list(camera.params)
    if camera.model.startswith("SIMPLE") or camera.model.startswith("RADIAL"):
        params.insert(0, params[0])
    fx, fy, cx, cy, *lens = params
    named = dict(zip(names, lens, strict=True))
    every = ("k1", "k2", "k3", "k4") if model == "OPENCV_FISHEYE" else ("k1", "k2", "p1", "p2")
    return {
        "camera_model": model,
        "w": camera.width,
        "h": camera.height,
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx,
        "cy": cy,
        **{name: named.get(name, 0.0) for name in every},
    }
