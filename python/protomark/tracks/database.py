"""Reads tracks from a COLMAP database with descriptors and from a model made from it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.features.descriptors import DESCRIPTORS, descriptor_kind
from protomark.features.extractor import Features
from protomark.features.sift import is_rooted, root_sift
from protomark.files import hash_files
from protomark.tracks.file import Tracks
from protomark.tracks.sqlite import has_tables, open_database

_MAX_PIXEL = 1e9  # a product of two such numbers is still a float32
# Pixels between a keypoint of model and database, as some programs count from another corner.
_MAX_SHIFT = 1.0
_SAMPLE = 100  # so many images tell whether SIFT is RootSIFT


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
        ValueError: there are no descriptors, or several kinds or none have that length.
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
            f"{database} has descriptors of {length} bytes, of which no encoder ships: name the "
            "folder of the images in its place, which are described anew"
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
    """Tracks with the descriptors of a database, and the landmarks of a model made from it.

    A landmark with two observations in one image keeps the one with the smaller reprojection error;
    landmarks with fewer than two observations are left out, and so are SIFT's keypoints without a
    descriptor. SIFT that is no RootSIFT becomes it.

    Raises:
        FileNotFoundError, ValueError: database or model are missing or broken, or the keypoints of
            the model are not those of the database.
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
    ids = {point_id: row for row, point_id in enumerate(sorted(reconstruction.points3D))}
    positions = np.array([reconstruction.points3D[i].xyz for i in sorted(ids)], np.float64)
    features, labels = [], []
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
        try:
            labels.append(_labels(image, reconstruction.points3D, ids, found.keypoints))
        except ValueError as error:
            raise ValueError(f"{database}: image {image_name}: {error}") from None
        features.append(found)
    del by_name
    facts: dict[str, Any] = {}
    if kind.name == "sift":
        facts = _to_root_sift(database, features, labels)
    label = np.concatenate(labels)
    count = np.bincount(label[label >= 0], minlength=len(positions))
    keep = np.flatnonzero(count >= 2)
    number = np.full(len(positions) + 1, -1, np.int64)
    number[keep] = np.arange(len(keep))
    made_from = provenance(database, model_path, descriptor)
    with open_database(database, "a COLMAP database") as tables:
        version = tables.user_version
    source = {"program": "COLMAP", "version": version, "digest": made_from["input"]}
    info = {
        "sequence": name,
        "source": source | facts.pop("source", {}),
        **facts,
        **made_from,
        "images_without_pose": model.unposed,
        "poses_refined": False,
    }
    return Tracks.from_features(kind.name, model, features, number[label], positions[keep], info)


def _labels(
    image: Any, points: Any, ids: dict[int, int], keypoints: NDArray[np.float32]
) -> NDArray[np.int64]:
    """Landmark (n,) of each keypoint of an image, -1 for none, each at most once."""
    rows = np.array(image.get_observation_point2D_idxs(), np.int64)
    if not len(rows):
        return np.full(len(keypoints), -1, np.int64)
    all_points = image.points2D
    seen = [all_points[row] for row in rows.tolist()]
    off = np.abs(np.array([point.xy for point in seen]) - keypoints[rows]).max(1)
    if off.max() > _MAX_SHIFT:
        raise ValueError(
            f"{(off > _MAX_SHIFT).sum():,} of {len(rows):,} observations of the model are up to "
            f"{off.max():.1f} pixels from the database's keypoints: give the database of this "
            "model, or if its images were undistorted later, the model from before"
        )
    error = np.full(len(keypoints), np.inf)
    label = np.full(len(keypoints), -1, np.int64)
    for row, point in zip(rows.tolist(), seen, strict=True):
        label[row] = ids[point.point3D_id]
        pixel = image.project_point(points[point.point3D_id].xyz)
        if pixel is not None:
            error[row] = float(np.linalg.norm(pixel - keypoints[row]))
    order = np.lexsort((error, label))
    # Label -1 repeats, too, and stays -1.
    twice = order[1:][label[order[1:]] == label[order[:-1]]]
    label[twice] = -1
    return label


def _to_root_sift(
    database: Path, features: list[Features], labels: list[NDArray[np.int64]]
) -> dict[str, Any]:
    """Make the descriptors of all images RootSIFT, in place; returns what `info` says of it."""
    empty = 0
    for i, found in enumerate(features):
        full = np.asarray(found.descriptors.any(1))
        if not full.all():
            empty += int((~full).sum())
            features[i], labels[i] = found.where(full), labels[i][full]
    sample = [f.descriptors for f in features[:: -(-len(features) // _SAMPLE)] if len(f)]
    if not sample:
        raise ValueError(f"{database}: no keypoint of the model's images has a descriptor")
    try:
        rooted, certain = is_rooted(np.concatenate(sample))
    except ValueError as error:
        raise ValueError(
            f"{database} has {error}: name the folder of the images in its place, which are "
            "described anew"
        ) from None
    if not rooted:
        for found in features:
            found.descriptors = root_sift(found.descriptors)
    upright = all(not (found.angles % 360).any() for found in features)
    source: dict[str, Any] = {}
    if not (rooted and certain):
        source["note"] = "taken for RootSIFT" if rooted else "SIFT, whose root is taken"
    if empty:
        source["dropped"] = {"keypoints whose descriptor is zero": empty}
    detector: dict[str, Any] = {"name": "COLMAP", "max_keypoints": max(map(len, features))}
    return {"source": source, "detector": detector | ({"upright": True} if upright else {})}


def read_features(database: Path, descriptor: str, width: int) -> dict[str, Features]:
    """Keypoints and descriptors by image name."""
    images: dict[str, Features] = {}
    with open_database(database, "a COLMAP database") as tables:
        names = dict(tables.rows_by_id("images", "name", "image_id"))
        keypoints = dict(tables.rows_by_id("keypoints", "rows, cols, data", "image_id"))
        descriptors = dict(tables.rows_by_id("descriptors", "rows, cols, data", "image_id"))
    empty = (None, None, None)
    for image_id, (name,) in names.items():
        kr, kc, kd = keypoints.pop(image_id, empty)
        dr, dc, dd = descriptors.pop(image_id, empty)
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
