"""Seals what there is, a folder of `protomark map`, a learning map or tracks, to a size."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.extras import optional
from protomark.files import SCENE_MAP, STATE
from protomark.maps.build import build_map
from protomark.maps.info import is_tracks
from protomark.maps.open import open_learning_map
from protomark.maps.origin import tracks_metadata
from protomark.maps.selection import Views, select_landmarks
from protomark.maps.sources import read_places
from protomark.progress import Progress, silent
from protomark.tracks.file import Tracks

Index = Literal["auto", "yes", "no"]
# Landmark ids (n,), and their descriptors (n, bits / 8) uint8 or codes (n, dim) int8.
Observations = tuple[NDArray[np.int64], NDArray[np.uint8] | NDArray[np.int8]]

BYTES_PER_LANDMARK = 33.0
# An exact search of fewer prototypes is as fast (docs/large-maps.md).
INDEX_FROM = 100_000
# The smallest map that is tried: a pose needs four landmarks.
MIN_LANDMARKS = 4
MODEL = "sparse"
# Of so many observations the own prototype is nearer than another one, if both are of one map.
_MIN_ALIKE = 0.75


@dataclass(frozen=True)
class SealRequest:
    """How large a sealed map may be, and what it holds."""

    # For prototypes and their number, on average; None: lossless.
    bytes_per_landmark: float | None = BYTES_PER_LANDMARK
    megabytes: float | None = None  # of the whole file, 10^6 bytes; None: no limit
    landmarks: int | None = None  # how many to keep at most; None: all
    index: Index = "auto"  # whether to build one: "auto" from `INDEX_FROM` prototypes on
    position_bits: int = 16  # per coordinate: 32, 16, or 0 for no positions
    tune: bool = True  # whether prototypes are tuned against each other
    threads: int = 1  # threads to encode, build the index and tune on


def sealed_path(path: Path) -> Path:
    """The sealed map beside a learning map: scene.pmk and scene.sealed.pmk."""
    return path.with_name(f"{path.name.removesuffix('.pmk')}.sealed.pmk")


def seal(
    source: Path, output: Path, request: SealRequest | None = None, progress: Progress = silent
) -> dict[str, Any]:
    """Seal a folder of `protomark map`, a learning map or tracks; returns facts, see `seal_map`."""
    request = request or SealRequest()
    check_replaceable(output)
    progress("read the map", 0, 0)
    if is_tracks(source):
        tracks = read_places([source])
        encoder = pm.Encoder.load(tracks.encoder_name)
        scene = build_map(tracks, encoder, encoder.dim, threads=request.threads)
        scene.metadata = tracks_metadata(tracks)
        return seal_map(
            scene, output, request, lambda: Views.of_tracks(tracks), observed(tracks), progress
        )
    scene = open_learning_map(source)
    model = source / MODEL
    views = (lambda: Views.of_model(model)) if model.is_dir() else None
    return seal_map(scene, output, request, views, codes_of(source, scene), progress)


def check_replaceable(output: Path) -> None:
    """Raise ValueError if a file to write a sealed map to is a learning map."""
    with suppress(pm.FileError, OSError):
        if "sums" not in dict(pm.file_sections(output)):
            return
        raise ValueError(
            f"{output} is a learning map, which a sealed one would replace: name another file, "
            f"such as {sealed_path(output)}"
        )


def codes_of(folder: Path, scene: pm.PrototypeMap) -> Observations | None:
    """The codes of observations that `protomark map` keeps in a folder.

    None if there are none, or if they are not of this map, which somebody put there.

    Raises:
        ValueError: the file is broken.
    """
    path = folder / STATE
    if not path.is_file():
        return None
    safetensors = optional("safetensors")
    try:
        with safetensors.safe_open(path, "numpy") as file:
            ids, codes = file.get_tensor("landmarks"), file.get_tensor("codes")
        rows = np.flatnonzero(np.isin(ids, scene.ids))[:1000]
        others = np.roll(rows, len(rows) // 2)
        own, other = (
            ((scene.prototypes(ids[r]) - codes[rows]) ** 2).sum(axis=1) for r in (rows, others)
        )
    except (safetensors.SafetensorError, ValueError, IndexError) as error:
        raise ValueError(
            f"{path}: broken ({error}): seal {folder / SCENE_MAP}, or map the images anew"
        ) from None
    return (ids, codes) if len(rows) and (own < other).mean() > _MIN_ALIKE else None


def observed(tracks: Tracks) -> Observations:
    """The observations of tracks."""
    rows = tracks.observations
    return tracks.landmark_of_keypoint[rows], tracks.descriptors[rows]


def seal_map(
    scene: pm.PrototypeMap,
    output: Path,
    request: SealRequest | None = None,
    # Gives the images that saw its landmarks, if landmarks have to be chosen; None: they are chosen
    # by where they are in space.
    views: Callable[[], Views] | None = None,
    # The observations to tune prototypes by; None: the map's appearances.
    observations: Observations | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Seal a learning map, which stays as it is but for its index.

    Returns:
        Landmarks of the sealed map and of the source, by what they were chosen (None: all were
        kept), and bytes.
    """
    request = request or SealRequest()
    total = len(scene)
    limit = total if request.landmarks is None else request.landmarks
    if not 0 < limit <= max(total, 1):
        raise ValueError(f"{limit} landmarks cannot be kept: the map has {total}")
    if request.position_bits and not scene.summary()["landmarks_with_position"]:
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
    if request.megabytes is not None:
        if not request.megabytes > 0:
            raise ValueError(f"--megabytes {request.megabytes:g} is not above 0")
        with tempfile.TemporaryDirectory(prefix="protomark-") as folder:
            path = Path(folder) / "map.pmk"
            untuned = replace(request, tune=False)
            while _seal_once(best(count), path, untuned) > request.megabytes * 1e6:
                count = _fitting_count(path, count, request.megabytes * 1e6)
    size = _seal_once(best(count), output, request, observations)
    by = "images" if views else "space"
    return {
        "landmarks": count,
        "landmarks_of_the_source": total,
        "chosen_by": by if count < total else None,
        "bytes": size,
    }


def _seal_once(
    scene: pm.PrototypeMap,
    path: Path,
    request: SealRequest,
    observations: Observations | None = None,
) -> int:
    """Seal a whole map; returns the bytes of the file."""
    wanted = request.index == "yes" or (
        request.index == "auto" and scene.prototype_count >= INDEX_FROM
    )
    if wanted and not scene.nlist:
        scene.build_index(threads=request.threads)
    elif request.index == "no":
        scene.drop_index()
    try:
        scene.seal(
            path,
            *(observations or (None, None)),
            bytes_per_landmark=request.bytes_per_landmark,
            position_bits=request.position_bits,
            tune=request.tune,
            threads=request.threads,
        )
    except ValueError as error:
        told = str(error).replace("bytes_per_landmark", "--bytes")
        raise ValueError(told.replace("position_bits", "--position-bits")) from None
    return path.stat().st_size


def _fitting_count(path: Path, count: int, limit: float) -> int:
    """How many landmarks fit into `limit` bytes, by a sealed map with `count`, too many."""
    fixed = sum(size for name, size in pm.file_sections(path) if name in ("encoder", "metadata"))
    each = (path.stat().st_size - fixed) / count
    fitting = min(int((0.998 * limit - fixed) / each), count - 1)
    if fitting < MIN_LANDMARKS:
        raise ValueError(
            f"{limit / 1e6:g} MB are too few: {MIN_LANDMARKS} landmarks and the encoder take "
            f"{(fixed + MIN_LANDMARKS * each) / 1e6:.2f} MB"
        )
    return fitting


def _by_usefulness(
    scene: pm.PrototypeMap, count: int, views: Callable[[], Views] | None
) -> NDArray[np.int64]:
    ids = scene.ids
    if views is not None:
        return select_landmarks(ids, views(), count)
    return select_landmarks(ids, Views.of_space(scene), count, scene.counts(ids))
