"""Seals what there is, a folder of `protomark map`, a learning map or tracks, to a size."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.maps.build import build_map
from protomark.maps.cameras import KEY, cameras_text
from protomark.maps.info import is_tracks
from protomark.maps.merge import open_learning_map
from protomark.maps.open import SCENE_MAP
from protomark.maps.selection import Views, select_landmarks
from protomark.progress import Progress, silent
from protomark.tracks.file import Tracks

Index = Literal["auto", "yes", "no"]

BYTES_PER_LANDMARK = 33.0
# An exact search of fewer prototypes is as fast (docs/large-maps.md).
INDEX_FROM = 100_000
# The smallest map that is tried: a pose needs four landmarks.
MIN_LANDMARKS = 4
MODEL = "sparse"
_SIZE_STEPS = 8


@dataclass(frozen=True)
class SealOptions:
    """How large a sealed map may be, and what it holds.

    Attributes:
        bytes_per_landmark: for prototypes, their number and count, on average; None: lossless.
        megabytes: of the whole file, 10^6 bytes; None: no limit.
        landmarks: how many to keep at most; None: all.
        index: whether to build one: "auto" from `INDEX_FROM` prototypes on.
        position_bits: per coordinate: 32, 16, or 0 for no positions.
        threads: threads to encode and build the index on.
    """

    bytes_per_landmark: float | None = BYTES_PER_LANDMARK
    megabytes: float | None = None
    landmarks: int | None = None
    index: Index = "auto"
    position_bits: int = 16
    threads: int = 1


def sealed_path(path: Path) -> Path:
    """The sealed map beside a learning map: scene.pmk and scene.sealed.pmk."""
    return path.with_name(f"{path.name.removesuffix('.pmk')}.sealed.pmk")


def seal(
    source: Path, output: Path, options: SealOptions | None = None, progress: Progress = silent
) -> dict[str, Any]:
    """Seal a scene; where not all landmarks may stay, those that cover it best.

    Args:
        source: a folder of `protomark map`, a learning map or a tracks file.
        output: the file to write.
        options: how large it may be.
        progress: called with each stage.

    Returns:
        Facts: landmarks of the sealed map and of the source, by what they were chosen (None: all
        were kept), and bytes.

    Raises:
        FileNotFoundError, FileError, ValueError: the source is none of these, or a size cannot be
            met.
    """
    options = options or SealOptions()
    progress("read the map", 0, 0)
    if is_tracks(source):
        tracks = Tracks.load(source)
        scene = build_map(tracks, pm.Encoder.load(tracks.descriptor), threads=options.threads)
        scene.metadata = {KEY: cameras_text(tracks.cameras.values())}
        return seal_map(scene, output, options, lambda: Views.of_tracks(tracks), progress)
    if not source.is_dir():
        return seal_map(open_learning_map(source), output, options, None, progress)
    if not (source / SCENE_MAP).is_file():
        raise FileNotFoundError(
            f"{source}: no {SCENE_MAP} in this folder; name a learning map or tracks"
        )
    scene = open_learning_map(source / SCENE_MAP)
    model = source / MODEL
    views = (lambda: Views.of_model(model)) if model.is_dir() else None
    return seal_map(scene, output, options, views, progress)


def seal_map(
    scene: pm.PrototypeMap,
    output: Path,
    options: SealOptions | None = None,
    views: Callable[[], Views] | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Seal a learning map, which stays as it is but for its index.

    Args:
        scene: the map.
        output: the file to write.
        options: how large it may be.
        views: gives the images that saw its landmarks, if landmarks have to be chosen; None: they
            are chosen by where they are in space.
        progress: called with each stage.

    Returns:
        Facts, see `seal`.

    Raises:
        FileError, ValueError: see `seal`.
    """
    options = options or SealOptions()
    total = len(scene)
    limit = total if options.landmarks is None else options.landmarks
    if not 0 < limit <= max(total, 1):
        raise ValueError(f"{limit} landmarks cannot be kept: the map has {total}")
    if options.position_bits and not scene.summary()["landmarks_with_position"]:
        raise ValueError(
            "no landmark of the map has a position: seal it without positions (--no-positions)"
        )
    order: NDArray[np.int64] | None = None

    def best(count: int) -> pm.PrototypeMap:
        nonlocal order
        if count == total:
            return scene
        if order is None:
            progress("choose landmarks", 0, 0)
            order = _by_usefulness(scene, limit, views)
        return scene.part(order[:count])

    progress("seal", 0, 0)
    count = limit
    if options.megabytes is not None:
        with tempfile.TemporaryDirectory(prefix="protomark-") as folder:
            count = _fitting_count(
                lambda n: _seal_once(best(n), Path(folder) / "map.pmk", options),
                limit,
                options.megabytes * 1e6,
            )
    size = _seal_once(best(count), output, options)
    by = "images" if views else "space"
    return {
        "landmarks": count,
        "landmarks_of_the_source": total,
        "chosen_by": by if count < total else None,
        "bytes": size,
    }


def _seal_once(scene: pm.PrototypeMap, path: Path, options: SealOptions) -> int:
    """Seal a whole map; returns the bytes of the file."""
    wanted = options.index == "yes" or (
        options.index == "auto" and scene.prototype_count >= INDEX_FROM
    )
    if wanted and not scene.nlist:
        scene.build_index(threads=options.threads)
    elif options.index == "no":
        scene.drop_index()
    scene.seal(
        path, bytes_per_landmark=options.bytes_per_landmark, position_bits=options.position_bits
    )
    return path.stat().st_size


def _fitting_count(seal: Callable[[int], int], count: int, limit: float) -> int:
    """The most landmarks that take at most `limit` bytes, within a hundredth of them.

    Args:
        seal: gives the bytes of a sealed map of so many landmarks.
        count: all of them.
        limit: bytes.
    """
    size = seal(count)
    if size <= limit:
        return count
    fits, above = min(MIN_LANDMARKS, count), count
    fitting = seal(fits)
    if fitting > limit:
        raise ValueError(
            f"{limit / 1e6:g} MB are too few: {fits} landmarks and the encoder take "
            f"{fitting / 1e6:.2f} MB"
        )
    for _ in range(_SIZE_STEPS):
        if above - fits <= 1 or fitting >= 0.99 * limit:
            break
        # By the line through the smaller and the larger map, a little below the limit.
        share = (0.998 * limit - fitting) / max(size - fitting, 1)
        tried = min(max(fits + int(share * (above - fits)), fits + 1), above - 1)
        tried_size = seal(tried)
        if tried_size <= limit:
            fits, fitting = tried, tried_size
        else:
            above, size = tried, tried_size
    return fits


def _by_usefulness(
    scene: pm.PrototypeMap, count: int, views: Callable[[], Views] | None
) -> NDArray[np.int64]:
    ids = scene.ids
    if views is not None:
        return select_landmarks(ids, views(), count)
    return select_landmarks(ids, Views.of_space(scene), count, scene.counts(ids))
