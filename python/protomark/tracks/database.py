"""Reads tracks from a COLMAP database with descriptors and from a model made from it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.features.descriptors import DESCRIPTORS, DescriptorKind, descriptor_kind
from protomark.features.extractor import Features
from protomark.features.sift import is_rooted, root_sift
from protomark.files import hash_files
from protomark.tracks.file import Tracks
from protomark.tracks.sqlite import has_tables, open_database

_MAX_PIXEL = 1e9  # a product of two such numbers is still a float32
# Pixels between a keypoint of model and database, as some programs count from another corner.
_MAX_SHIFT = 1.0
_SAMPLE = 300  # keypoints of as many images tell whether SIFT is RootSIFT


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
    database: Path,
    model_path: Path,
    descriptor: str,
    name: str = "",
    observed_only: bool = False,  # leave out keypoints of no landmark, most of a database's bytes
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
    ids = {point_id: row for row, point_id in enumerate(sorted(reconstruction.points3D))}
    positions = np.array([reconstruction.points3D[i].xyz for i in sorted(ids)], np.float64)
    image_ids = dict(zip(model.names, model.image_ids.tolist(), strict=True))
    sift = _SiftKeypoints() if kind.name == "sift" else None
    found: dict[str, tuple[Features, NDArray[np.int64]]] = {}
    for image_name, features in _each_image(database, kind):
        if image_name not in image_ids:
            continue
        image = reconstruction.images[image_ids[image_name]]
        if len(features) != image.num_points2D():
            raise ValueError(
                f"{database}: image {image_name} has {len(features)} keypoints, but "
                f"{image.num_points2D()} in the model: give the database of this model"
            )
        try:
            label = _labels(image, reconstruction.points3D, ids, features.keypoints)
        except ValueError as error:
            raise ValueError(f"{database}: image {image_name}: {error}") from None
        keep = sift.usable(features) if sift else np.ones(len(features), bool)
        keep &= (label >= 0) | (not observed_only)
        found[image_name] = features.where(keep), label[keep]
    if lacking := [one for one in model.names if one not in found]:
        raise ValueError(
            f"{database}: image {lacking[0]} of the model is not in the database: give the "
            "database of this model"
        )
    every = [found[one][0] for one in model.names]
    label = np.concatenate([found[one][1] for one in model.names])
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
        "source": source,
        **made_from,
        "images_without_pose": model.unposed,
        "poses_refined": False,
    }
    if sift:
        try:
            sift.take_root(every, info)
        except ValueError as error:
            raise ValueError(
                f"{database} has {error}: name the folder of the images in its place, which are "
                "described anew"
            ) from None
    return Tracks.from_features(kind.name, model, every, number[label], positions[keep], info)


class _SiftKeypoints:
    """What the SIFT keypoints of a database tell of how they were made."""

    def __init__(self) -> None:
        self._empty, self._most, self._upright = 0, 0, True
        self._sample: list[NDArray[np.uint8]] = []

    def usable(self, features: Features) -> NDArray[np.bool_]:
        """Which keypoints (n,) of an image have a descriptor that is not zero."""
        full = np.asarray(features.descriptors.any(1))
        self._empty += int((~full).sum())
        self._most = max(self._most, len(features))
        self._upright &= not (features.angles % 360).any()
        if len(self._sample) < _SAMPLE:
            self._sample.append(features.descriptors[full][:: -(-len(features) // _SAMPLE) or 1])
        return full

    def take_root(self, images: list[Features], info: dict[str, Any]) -> None:
        """Make the descriptors of images RootSIFT, and tell `info` of them.

        Raises:
            ValueError: they are not SIFT.
        """
        sample = np.concatenate([np.zeros((0, 128), np.uint8), *self._sample])
        if not len(sample):
            raise ValueError("no descriptors of the model's images")
        rooted, certain = is_rooted(sample)
        if not rooted:
            for features in images:
                features.descriptors = root_sift(features.descriptors)
        if not (rooted and certain):
            info["source"]["note"] = "taken for RootSIFT" if rooted else "SIFT, whose root is taken"
        if self._empty:
            info["source"]["dropped"] = {"keypoints whose descriptor is zero": self._empty}
        info["detector"] = {"name": "COLMAP", "max_keypoints": self._most}
        if self._upright:
            info["detector"]["upright"] = True


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


def read_features(database: Path, descriptor: str) -> dict[str, Features]:
    """Keypoints and descriptors by image name."""
    return dict(_each_image(database, descriptor_kind(descriptor)))


def _each_image(database: Path, kind: DescriptorKind) -> Iterator[tuple[str, Features]]:
    """Names and features of the images, one at a time, as descriptors are most of a database."""
    broken = f"{database}: not a COLMAP database, or a broken one"
    with open_database(database, "a COLMAP database") as tables:
        names = {i: name for i, (name,) in tables.rows_by_id("images", "name", "image_id")}
        counts = Counter(names.values())
        if len(counts) < len(names):
            raise ValueError(f"{database}: two images have the name {counts.most_common(1)[0][0]}")
        keypoints = dict(tables.rows_by_id("keypoints", "rows, cols, data", "image_id"))
        described = tables.rows_by_id("descriptors", "rows, cols, data", "image_id")
        # Images without descriptors come last.
        for image_id, row in chain(described, ((i, (None,) * 3) for i in list(names))):
            if image_id not in names:
                continue
            name = names.pop(image_id)
            kr, kc, kd = keypoints.pop(image_id, (None,) * 3)
            dr, dc, dd = row
            kr, kc, kd = kr or 0, kc or 2, kd or b""
            dr, dc, dd = dr or 0, dc or kind.bytes, dd or b""
            numbers_fit = all(isinstance(number, int) for number in (kr, kc, dr, dc))
            if not (numbers_fit and isinstance(name, str) and type(kd) is type(dd) is bytes):
                raise ValueError(broken)
            if dr and dc != kind.bytes:
                guess = [k.name for k in DESCRIPTORS.values() if k.bytes == dc]
                raise ValueError(
                    f"{database}: image {name} has descriptors of {dc} bytes, but {kind.name} has "
                    f"{kind.bytes}: take "
                    + (" or ".join(guess) if guess else "the descriptor that it has")
                )
            if kr != dr or kc < 2 or len(kd) != 4 * kr * kc or len(dd) != dr * dc:
                raise ValueError(
                    f"{database}: the {kr} keypoints and {dr} descriptors of image {name} do not "
                    "fit together: extract its features anew"
                )
            points = np.frombuffer(kd, "<f4").reshape(kr, kc)
            if not (np.abs(points) < _MAX_PIXEL).all():
                raise ValueError(f"{database}: image {name} has keypoints far outside of any image")
            yield name, _features(points, np.frombuffer(dd, np.uint8).reshape(dr, dc))


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
