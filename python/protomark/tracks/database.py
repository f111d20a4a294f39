"""Reads tracks from a COLMAP database and model that already hold binary descriptors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.features.descriptors import DESCRIPTORS, descriptor_kind
from protomark.features.extractor import Features
from protomark.files import hash_files
from protomark.tracks.file import Tracks
from protomark.tracks.sqlite import has_tables, open_database

_MAX_PIXEL = 1e9  # a product of two such numbers is still a float32


def provenance(database: Path, model: Path, descriptor: str) -> dict[str, Any]:
    """What the tracks are made from and how, for their `info`: equal for equal tracks.

    The input is a digest of the content of the database and of the model's files.
    """
    paths = (database, *sorted(p for p in model.iterdir() if p.is_file()))
    digest = hash_files((path.name, path) for path in paths)
    options = {"descriptor": descriptor_kind(descriptor).name, "database": True}
    return {"options": options, "input": digest}


def is_database(path: Path, head: bytes) -> bool:
    """Whether a file that begins with `head` is a COLMAP database."""
    return has_tables(path, head, ("images", "keypoints", "descriptors", "two_view_geometries"))


def stored_descriptor(database: Path) -> str:
    """The descriptor of a database, which only the length tells; of 32 bytes most are ORB.

    COLMAP's column `type` does not tell: opened by COLMAP 4, an older database calls ORB SIFT.

    Raises:
        ValueError: there are no binary descriptors, or several kinds have that length.
    """
    with open_database(database, "a COLMAP database") as tables:
        lengths = {cols for rows, cols in tables.rows("descriptors", "rows, cols") if rows}
    if len(lengths) != 1:
        what = f"descriptors of {len(lengths)} lengths" if lengths else "no descriptors"
        raise ValueError(
            f"{database}: the database has {what}: name the folder of the images in its place, "
            "which are described anew"
        )
    length = lengths.pop()
    kinds = [kind.name for kind in DESCRIPTORS.values() if kind.bytes == length]
    if not kinds:
        raise ValueError(
            f"{database} has descriptors of {length} bytes, of which no encoder ships (128: SIFT): "
            "name the folder of the images in its place, which are described anew"
        )
    if len(kinds) > 1 and "orb" not in kinds:
        raise ValueError(
            f"{database} has descriptors of {length} bytes: name one of {', '.join(kinds)} with "
            "--encoder"
        )
    return "orb" if "orb" in kinds else kinds[0]


def tracks_from_database(
    database: Path, model_path: Path, descriptor: str, name: str = ""
) -> Tracks:
    """Tracks with the binary descriptors of a database, and the landmarks of a model made from it.

    A landmark with two observations in one image keeps the one with the smaller reprojection error;
    landmarks with fewer than two observations are left out.
    """
    from protomark.geometry.colmap import model_from_reconstruction, read_reconstruction

    if not database.is_file():
        raise FileNotFoundError(f"{database}: no such COLMAP database")
    kind = descriptor_kind(descriptor)
    reconstruction = read_reconstruction(model_path)
    model = model_from_reconstruction(reconstruction, model_path)
    if not reconstruction.points3D:
        raise ValueError(
            f"{model_path}: the model has no points, so the database's descriptors have no "
            "landmarks: run `protomark tracks` without --database to make them from the images"
        )
    by_name = read_features(database, kind.name, kind.bytes)
    features, labels = [], []
    ids = {point_id: row for row, point_id in enumerate(sorted(reconstruction.points3D))}
    positions = np.array([reconstruction.points3D[i].xyz for i in sorted(ids)], np.float64)
    for image_id, image_name in zip(model.image_ids, model.names, strict=True):
        image = reconstruction.images[int(image_id)]
        if image_name not in by_name:
            raise ValueError(
                f"{database}: image {image_name} of the model is not in the database: give the "
                "database of this model"
            )
        found = by_name[image_name]
        if len(found) != image.num_points2D():
            raise ValueError(
                f"{database}: image {image_name} has {len(found)} keypoints, but "
                f"{image.num_points2D()} in the model: give the database of this model"
            )
        label = np.full(len(found), -1, np.int64)
        error = np.full(len(found), np.inf)
        for row in image.get_observation_point2D_idxs():
            point_id = image.points2D[row].point3D_id
            label[row] = ids[point_id]
            seen = image.project_point(reconstruction.points3D[point_id].xyz)
            if seen is not None:
                error[row] = float(np.linalg.norm(seen - found.keypoints[row]))
        order = np.lexsort((error, label))
        # Label -1 repeats, too, and stays -1.
        twice = order[1:][label[order[1:]] == label[order[:-1]]]
        label[twice] = -1
        features.append(found)
        labels.append(label)
    label = np.concatenate(labels)
    count = np.bincount(label[label >= 0], minlength=len(positions))
    keep = np.flatnonzero(count >= 2)
    number = np.full(len(positions) + 1, -1, np.int64)
    number[keep] = np.arange(len(keep))
    made_from = provenance(database, model_path, descriptor)
    with open_database(database, "a COLMAP database") as tables:
        version = tables.user_version
    info = {
        "sequence": name,
        "source": {"program": "COLMAP", "version": version, "digest": made_from["input"]},
        **made_from,
        "images_without_pose": model.unposed,
        "poses_refined": False,
    }
    return Tracks.from_features(kind.name, model, features, number[label], positions[keep], info)


def read_features(database: Path, descriptor: str, width: int) -> dict[str, Features]:
    """Keypoints and descriptors by image name."""
    with open_database(database, "a COLMAP database") as tables:
        names = dict(tables.rows_by_id("images", "name", "image_id"))
        keypoints = dict(tables.rows_by_id("keypoints", "rows, cols, data", "image_id"))
        descriptors = dict(tables.rows_by_id("descriptors", "rows, cols, data", "image_id"))
    images: dict[str, Features] = {}
    empty = (None, None, None)
    for image_id, (name,) in names.items():
        kr, kc, kd = keypoints.get(image_id, empty)
        dr, dc, dd = descriptors.get(image_id, empty)
        kr, kc, kd = kr or 0, kc or 2, kd or b""
        dr, dc, dd = dr or 0, dc or width, dd or b""
        numbers_fit = all(isinstance(number, int) for number in (kr, kc, dr, dc))
        if not (numbers_fit and isinstance(name, str) and type(kd) is type(dd) is bytes):
            raise ValueError(f"{database}: not a COLMAP database, or a broken one")
        if name in images:
            raise ValueError(f"{database}: two images have the name {name}")
        if dr and dc != width:
            guess = [k.name for k in DESCRIPTORS.values() if k.bytes == dc]
            raise ValueError(
                f"{database}: image {name} has descriptors of {dc} bytes, but {descriptor} has "
                f"{width}: name the right descriptor with -d"
                + (f" ({' or '.join(guess)})" if guess else "")
            )
        if kr != dr or kc < 2 or len(kd) != 4 * kr * kc or len(dd) != dr * dc:
            raise ValueError(
                f"{database}: the {kr} keypoints and {dr} descriptors of image {name} do not fit "
                "together: extract its features anew"
            )
        points = np.frombuffer(kd, "<f4").reshape(kr, kc)
        if not (np.abs(points) < _MAX_PIXEL).all():
            raise ValueError(f"{database}: image {name} has keypoints far outside of any image")
        images[name] = _features(points, np.frombuffer(dd, np.uint8).reshape(dr, dc))
    return images


def _features(k: NDArray[np.float32], descriptors: NDArray[np.uint8]) -> Features:
    """Features with COLMAP's scale and angle: none, (scale, radians), or an affine shape."""
    n = len(k)
    sizes, angles = np.ones(n, np.float32), np.full(n, -1, np.float32)
    if k.shape[1] == 4:
        sizes, turn = 2 * k[:, 2], np.degrees(k[:, 3])
        angles = np.mod(turn, 360).astype(np.float32)
    elif k.shape[1] >= 6:
        sizes = 2 * np.sqrt(np.abs(k[:, 2] * k[:, 5] - k[:, 3] * k[:, 4]))
        angles = np.mod(np.degrees(np.arctan2(k[:, 4], k[:, 2])), 360).astype(np.float32)
    angles[angles >= 360] = 0
    zeros = np.zeros(n, np.float32)
    xy = np.ascontiguousarray(k[:, :2], np.float32)
    sizes = np.asarray(sizes, np.float32)
    return Features(xy, sizes, angles, zeros, zeros.astype(np.int32), descriptors.copy())
