"""Ground control points: where images show points whose world coordinates were measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.camera import Camera
from protomark.geometry.pose import camera_centers, turned
from protomark.geometry.pose_files import east_north_up, is_number, numbers, table
from protomark.geometry.triangulation import refine_points

Array = NDArray[np.float64]

# Rays of a point spread at least like two that meet at one degree.
_MIN_SPREAD = 1 - np.cos(np.radians(1))
_COLUMNS = 6
_DEGREES = ("4326", "longlat", "latlong")  # in the names of coordinate systems of these


@dataclass(frozen=True)
class ControlPoints:
    """p points, and their n marks in images."""

    names: list[str]  # of the points
    positions: Array  # (p, 3) world coordinates
    images: list[str]  # of the marks
    pixels: Array  # (n, 2), as in COLMAP
    points: NDArray[np.int64]  # (n,) index of the point that a mark shows
    frame: str = ""  # the world's coordinates in words, if the file says


def read_control_points(path: Path) -> ControlPoints | None:
    """Read marks of control points; None if it is another kind of file.

    A line is `image x y X Y Z`, with commas or without, and maybe the point's name; or, as in
    gcp_list.txt of OpenSfM and OpenDroneMap, `X Y Z x y image`. Equal X, Y and Z are one point. A
    first line may name the columns, or the coordinate system: latitude, longitude and altitude
    (in gcp_list.txt longitude first) become metres east, north and up of the first point.

    Raises:
        ValueError: a number is broken.
    """
    rows = table(path)
    top = rows[0][1] if rows else []
    headed = len(top) < _COLUMNS or not all(map(is_number, top[1:5]))
    header, rows = (rows[0][1], rows[1:]) if headed else ([], rows)
    if not rows or any(not _COLUMNS <= len(w) <= _COLUMNS + 1 for _, w in rows):
        return None
    last = not is_number(rows[0][1][5])  # the image's name
    if last:
        rows = [(number, [w[5], *w[3:5], *w[:3], *w[6:]]) for number, w in rows]
    values = np.array([numbers(path, number, w[1:6]) for number, w in rows])
    axes = {name.lower()[:3]: i for i, name in enumerate(header[3:6], 2)}
    if last and (header == ["WGS84"] or any(w in " ".join(header).lower() for w in _DEGREES)):
        axes = {"lon": 2, "lat": 3, "alt": 4}
    at, frame = values[:, 2:], ""
    if set(axes) == {"lat", "lon", "alt"}:
        at, frame = east_north_up(*values[:, [axes[name] for name in ("lat", "lon", "alt")]].T)
    _, first, points = np.unique(values[:, 2:], axis=0, return_index=True, return_inverse=True)
    names = [(*rows[i][1][6:], f"line {rows[i][0]}")[0] for i in first.tolist()]
    return ControlPoints(
        names, at[first], [w[0] for _, w in rows], values[:, :2], points.reshape(-1), frame
    )


def triangulate_marks(
    given: ControlPoints, found: Callable[[str], tuple[Camera, Array] | None]
) -> Array:
    """Where images show the points (p, 3); NaN if they do not from two directions.

    Args:
        given: the points and their marks.
        found: gives the camera and the pose of an image, None if it has none.
    """
    rows, poses, rays, focal, directions = [], [], [], [], []
    for i, name in enumerate(given.images):
        if (known := found(name)) is None:
            continue
        camera, pose = known
        pixel = given.pixels[i : i + 1]
        (ray,), turns = camera.local_rays(pixel)
        bearing = camera.bearings(pixel)[0]
        if not np.isfinite(bearing).all():
            raise ValueError(f"{name}: no camera sees pixel {pixel[0].tolist()}")
        rows.append(i)
        rays.append(ray)
        poses.append(turned(pose, turns).reshape(3, 4))
        focal.append(camera.focal_length)
        directions.append(pose[:, :3].T @ bearing)
    at = np.full((len(given.names), 3), np.nan)
    if not rows:
        return at
    points, cams = given.points[rows], np.array(poses)
    across = np.eye(3) - np.einsum("ni,nj->nij", directions, directions)
    normal, right = np.zeros((len(at), 3, 3)), np.zeros((len(at), 3))
    np.add.at(normal, points, across)
    np.add.at(right, points, (across @ camera_centers(cams)[:, :, None])[..., 0])
    clear = np.linalg.eigvalsh(normal)[:, 0] >= _MIN_SPREAD
    at[clear] = np.linalg.solve(normal[clear], right[clear][..., None])[..., 0]
    used = clear[points]
    index = np.cumsum(clear) - 1
    at[clear] = refine_points(
        at[clear],
        index[points[used]],
        cams[used],
        np.array(rays)[used],
        np.array(focal)[used],
    )
    return at
