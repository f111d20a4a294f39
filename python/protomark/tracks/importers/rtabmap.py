"""Reads databases of RTAB-Map, of schemas 0.11 to 0.23.

What their tables hold was read in RTAB-Map (BSD-3), corelib/src/DBDriverSqlite3.cpp, and checked on
databases of it: points are where their keypoints are seen within 1e-4 pixels if pixels have their
centres at whole numbers and images are rectified.

A word is an appearance, which several places may share, so it is no landmark. Observations of a
word become one where the depth image puts them at one place.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.features.extractor import Features
from protomark.files import hash_files
from protomark.geometry.camera import Camera
from protomark.geometry.neighbours import runs
from protomark.geometry.pose import compose, inverse, transform
from protomark.tracks.file import Tracks
from protomark.tracks.importers.keyframes import (
    Keyframe,
    checked_features,
    join,
    unexpected,
    without_collector,
)
from protomark.tracks.importers.rtabmap_values import calibration, matrix, rigid
from protomark.tracks.sqlite import Database, blob, has_tables, open_database

PROGRAM = "RTAB-Map"

# Kp/DetectorStrategy (Feature2D::Type) -> detector, and the descriptor if it is binary.
_DETECTORS = {
    **{"0": ("SURF", ""), "1": ("SIFT", ""), "2": ("ORB", "orb"), "3": ("FAST/FREAK", "freak")},
    **{"4": ("FAST/BRIEF", "brief"), "5": ("GFTT/FREAK", "freak"), "6": ("GFTT/BRIEF", "brief")},
    **{"7": ("BRISK", "brisk"), "8": ("GFTT/ORB", "orb"), "9": ("KAZE", "")},
    **{"10": ("ORB-octree", "orb"), "11": ("SuperPoint", ""), "12": ("SURF/FREAK", "freak")},
    **{"13": ("GFTT/DAISY", ""), "14": ("SURF/DAISY", ""), "15": ("PyDetector", "")},
}
_REMEDY = (
    "record it with Kp/DetectorStrategy 8 (GFTT/ORB), or export images and poses (rtabmap-export) "
    "and describe them anew with `protomark build images/ sparse/`"
)
_SETTINGS = {
    **{"Kp/MaxFeatures": "max_features", "GFTT/QualityLevel": "quality_level"},
    **{"GFTT/MinDistance": "min_distance", "GFTT/BlockSize": "block_size"},
    **{"ORB/NLevels": "levels", "ORB/ScaleFactor": "scale_factor"},
}
# Points of a word that are closer than this share of their distance from the camera are one.
_AGREEMENT = 0.05
# A word that is seen at more places than this tells nothing about the others.
_MAX_PLACES = 32
_CHUNK = 4096  # rows


def recognizes(path: Path, head: bytes) -> bool:
    """Whether a file that begins with `head` is a database of RTAB-Map."""
    return has_tables(path, head, ("Node", "Word", "Data"))


def read(path: Path) -> Tracks:
    """Read a database.

    A landmark has the id of its word; further ones of the same word, and those of further worlds,
    have it plus a multiple of 2**32. Poses are those of the optimized graph, if the database holds
    it; `info` has the range of ids in each world.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the database holds no features, or float descriptors, or it is broken.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such database of {PROGRAM}")
    dropped: Counter[str] = Counter()
    with (
        open_database(path, f"a database of {PROGRAM}") as database,
        unexpected(path, "database"),
        without_collector(),
    ):
        version = str(next((v for (v,) in database.rows("Admin", "version")), "unknown"))
        parameters = _parameters(database)
        strategy = parameters.get("Kp/DetectorStrategy", "unknown")
        detector, descriptor = _DETECTORS.get(strategy, (f"detector {strategy}", ""))
        found = _read_features(database, version, detector)
        poses = _read_poses(database, dropped)
        views = _read_views(database, poses, found, dropped)
    if not descriptor and found.descriptors.shape[1] != 32:
        raise ValueError(
            f"{path}: descriptors of {found.descriptors.shape[1]} bytes, of {detector}, are none "
            f"that Protomark knows: {_REMEDY}"
        )
    with unexpected(path, "landmarks"):
        landmarks = _find_landmarks(found, views, dropped)
    numbers: dict[Camera, int] = {}
    keyframes = []
    for view in views:
        number = numbers.setdefault(view.camera, len(numbers) + 1)
        with unexpected(path, view.name):
            features = found.features(view)
        keyframes.append(Keyframe(view.name, number, view.pose, features, found.label[view.rows]))
    source: dict[str, Any] = {
        "program": PROGRAM,
        "version": version,
        "digest": hash_files([("map", path)]),
    }
    source |= {"maps": _summaries(found, views), "dropped": dict(+dropped)}
    settings = {_SETTINGS[k]: float(v) for k, v in parameters.items() if k in _SETTINGS}
    info = {
        "source": source,
        "detector": {"name": detector, **settings},
    }
    cameras = {number: camera for camera, number in numbers.items()}
    return join(path, descriptor or "orb", cameras, keyframes, landmarks, info)


@dataclass
class _Features:
    """The rows of the table of features, n of them."""

    node: NDArray[np.int64]
    word: NDArray[np.int64]
    numbers: NDArray[np.float32]  # (n, 6): x, y, size, angle, response, octave
    points: NDArray[np.float32]  # (n, 3), in coordinates of the robot's base; NaN for none
    descriptors: NDArray[np.uint8]
    label: NDArray[np.int64]

    def features(self, view: _View) -> Features:
        x, y, size, angle, response, octave = self.numbers[view.rows].T
        xy = np.column_stack([x - view.left, y]) + np.float32(0.5)
        descriptors = self.descriptors[view.rows]
        return checked_features(xy, descriptors, size, angle, response, octave)


@dataclass
class _View:
    """A camera's image of a node."""

    name: str
    camera: Camera
    left: int  # where its image begins in the node's, which has those of all cameras in a row
    base_from_cam: NDArray[np.float64]
    world: int
    world_from_base: NDArray[np.float64]
    rows: NDArray[np.int64]  # of its features

    @property
    def pose(self) -> NDArray[np.float64]:
        return inverse(compose(self.world_from_base, self.base_from_cam))


def _parameters(database: Database) -> dict[str, str]:
    """The program's parameters when the database was written last."""
    if "parameters" not in database.columns("Info"):
        return {}
    *_, text = ["", *(str(t) for (t,) in database.rows("Info", "parameters") if t)]
    return dict(pair.partition(":")[::2] for pair in text.split(";"))


def _read_features(database: Database, version: str, detector: str) -> _Features:
    table = "Feature" if database.columns("Feature") else "Map_Node_Word"
    optional = [c for c in ("octave", "descriptor") if c in database.columns(table)]
    names = ["node_id, word_id, pos_x, pos_y, size, dir, response, depth_x, depth_y, depth_z"]
    rows = database.rows(table, ", ".join([*names, *optional]))
    parts = []
    words: dict[int, tuple[Any, ...]] | None = None
    while chunk := list(islice(rows, _CHUNK)):
        columns = list(zip(*chunk, strict=True))
        cells: Any = columns.pop() if "descriptor" in optional else [None] * len(chunk)
        if not all(cells):
            # Then the word has the descriptor, which is that of its first feature.
            words = dict(database.rows_by_id("Word", "descriptor")) if words is None else words
            pairs = zip(cells, columns[1], strict=True)
            cells = [cell or words.get(word, (None,))[0] for cell, word in pairs]
        blobs = cells if {*map(type, cells)} == {bytes} else list(map(blob, cells))
        sizes = set(map(len, blobs)) - {0}
        numbers = np.array(columns[2:], np.float64).T.astype(np.float32)  # None becomes NaN
        if "octave" not in optional:
            numbers = np.insert(numbers, 8, 0, axis=1)
        ids = np.array(columns[:2], np.int64)
        keep = np.array([len(blob) > 0 for blob in blobs])
        data = np.frombuffer(b"".join(blobs), np.uint8)
        if len(sizes) > 1:
            raise ValueError(f"features have descriptors of {' and '.join(map(str, sizes))} bytes")
        parts.append((*ids[:, keep], numbers[keep], data.reshape(keep.sum(), -1)))
    if not any(len(part[0]) for part in parts):
        nodes = sum(1 for _ in database.rows("Node", "id"))
        if not nodes:
            raise ValueError(
                f"{database.path}: this database of {PROGRAM} {version} is empty: give one that "
                "was recorded"
            )
        raise ValueError(
            f"{database.path}: this database of {PROGRAM} {version} has {nodes} node"
            f"{'s' * (nodes > 1)}, but no "
            "features with descriptors, of which landmarks are made: record it with Kp/MaxFeatures "
            "at 0 or above, or export its images (rtabmap-export) and give them to `protomark map`"
        )
    parts = [part for part in parts if len(part[0])]
    node, word, numbers, descriptors = (np.concatenate(p) for p in zip(*parts, strict=True))
    declared = next(iter(database.rows(table, "descriptor_size")))[0] if optional[1:] else None
    width = descriptors.shape[1]
    if width > 64 or width == 4 * (declared or 0):
        raise ValueError(
            f"{database.path}: this database of {PROGRAM} {version} has float descriptors "
            f"({detector}), but Protomark takes binary ones: {_REMEDY}"
        )
    none = np.full(len(node), -1, np.int64)
    values = numbers[:, [0, 1, 2, 3, 4, 8]]
    return _Features(node, word, values, numbers[:, 5:8], descriptors, none)


def _read_poses(
    database: Database, dropped: Counter[str]
) -> dict[int, tuple[int, NDArray[np.float64]]]:
    """World and world_from_base (3, 4) of each node that has a pose.

    Odometry begins anew in each session. The optimized graph puts sessions into one world, together
    with those of their nodes that it lacks; every other session is a world of its own.
    """
    sessions: dict[int, dict[int, NDArray[np.float64]]] = {}
    for node, (session, cell) in database.rows_by_id("Node", "map_id, pose"):
        if cell and (pose := rigid(blob(cell))) is not None:
            sessions.setdefault(int(session), {})[node] = pose
        else:
            dropped["keyframes without a pose"] += 1
    optimized = _optimized(database)
    out = {}
    for world, (_, odometry) in enumerate(sorted(sessions.items()), 1):
        known = np.array(sorted(optimized.keys() & odometry.keys()), np.int64)
        for node, pose in odometry.items():
            if not len(known):
                out[node] = (world, pose)
                continue
            nearest = int(known[np.abs(known - node).argmin()])
            correction = compose(optimized[nearest], inverse(odometry[nearest]))
            out[node] = (0, optimized.get(node, compose(correction, pose)))
    return out


def _optimized(database: Database) -> dict[int, NDArray[np.float64]]:
    """Poses of the optimized graph by node."""
    if not {"opt_ids", "opt_poses"} <= set(database.columns("Admin")):
        return {}
    for ids, poses in database.rows("Admin", "opt_ids, opt_poses"):
        if ids and poses:
            numbers = matrix(blob(ids), "<i4").ravel().tolist()
            matrices = matrix(blob(poses), "<f4").reshape(len(numbers), 48 // 4)
            found = zip(numbers, (rigid(row.tobytes()) for row in matrices), strict=True)
            return {number: pose for number, pose in found if pose is not None}
    return {}


def _read_views(
    database: Database,
    poses: dict[int, tuple[int, NDArray[np.float64]]],
    found: _Features,
    dropped: Counter[str],
) -> list[_View]:
    """The images with features, of the nodes with pose and calibration, in the nodes' order."""
    order = np.argsort(found.node, kind="stable")
    starts, lengths = runs(found.node[order])
    rows = {
        int(found.node[order[start]]): order[start : start + length]
        for start, length in zip(starts, lengths, strict=True)
    }
    views = []
    for node, (cell,) in sorted(database.rows_by_id("Data", "calibration")):
        if node not in rows or node not in poses or not cell:
            continue
        with unexpected(database.path, f"node {node}"):
            cameras = calibration(blob(cell))
        mine = rows.pop(node)
        width = cameras[0][0].width
        index = (found.numbers[mine, 0] // width).clip(0, len(cameras) - 1)
        for i, (camera, base_from_cam) in enumerate(cameras):
            name = f"node{node}" + (f"/camera{i}" if len(cameras) > 1 else "")
            here = mine[index == i]
            views.append(_View(name, camera, i * width, base_from_cam, *poses[node], here))
    dropped["keyframes without pose or camera"] += len(rows)
    if not views:
        raise ValueError("no node with features has a pose and a calibration")
    return views


def _summaries(found: _Features, views: list[_View]) -> list[dict[str, Any]]:
    """Counts of each world."""
    out = []
    for world in sorted({view.world for view in views}):
        mine = [view for view in views if view.world == world]
        label = np.concatenate([found.label[view.rows] for view in mine])
        seen = label[label >= 0]
        counts = {"landmarks": len(np.unique(seen)), "observations": len(seen)}
        ids = {"ids": [int(seen.min()), int(seen.max())]} if len(seen) else {}
        out.append({"id": world, "keyframes": len(mine), **counts, **ids})
    return out


def _find_landmarks(
    found: _Features, views: list[_View], dropped: Counter[str]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Label features with landmarks, and return ids (l,) and positions (l, 3) of these."""
    n = len(found.word)
    world, reach = np.full((n, 3), np.nan), np.zeros(n)
    view_of = np.zeros(n, np.int64)
    for i, view in enumerate(views):
        points = found.points[view.rows].astype(np.float64)
        world[view.rows] = transform(view.world_from_base, points)
        reach[view.rows] = np.linalg.norm(points - view.base_from_cam[:, 3], axis=1)
        view_of[view.rows] = i
    placed = (np.abs(world) < 1e9).all(axis=1)
    rows = np.flatnonzero((found.word > 0) & (found.word < 2**31) & placed)
    worlds = np.unique([view.world for view in views], return_inverse=True)[1]
    # Words of each world.
    key = found.word[rows] * len(views) + worlds[view_of[rows]]
    words, word = np.unique(key, return_inverse=True)
    place = np.full(len(rows), -1)
    ambiguous = np.zeros(len(rows), bool)
    for number in range(_MAX_PLACES):
        # The first feature of each word that is at none of its places is at a new one.
        leader = np.full(len(words), -1)
        waiting = np.flatnonzero(place < 0)[::-1]
        leader[word[waiting]] = waiting
        active = np.flatnonzero(leader[word] >= 0)
        if not len(active):
            break
        mine, own = rows[active], rows[leader[word[active]]]
        distance = np.linalg.norm(world[mine] - world[own], axis=1)
        near = active[distance <= _AGREEMENT * np.minimum(reach[mine], reach[own])]
        ambiguous[near[place[near] >= 0]] = True
        place[near[place[near] < 0]] = number
    lost = place < 0
    dropped["observations of words that are at two places"] += int((ambiguous | lost).sum())
    rows, place, word = (a[~(ambiguous | lost)] for a in (rows, place, word))
    places, landmark = np.unique(words[word] * _MAX_PLACES + place, return_inverse=True)
    owner, own_place = np.divmod(places, _MAX_PLACES)
    owner, own_world = np.divmod(owner, len(views))
    ids = owner + 2**32 * (own_place + _MAX_PLACES * own_world)
    count = np.bincount(landmark, minlength=len(ids))[:, None]
    sums = [np.bincount(landmark, axis, len(ids)) for axis in world[rows].T]
    positions = np.column_stack(sums) / count if len(ids) else np.zeros((0, 3))
    # Of several observations in an image the nearest one is kept.
    distance = np.linalg.norm(world[rows] - positions[landmark], axis=1)
    order = np.lexsort((distance, view_of[rows], landmark))
    starts, _ = runs((landmark * len(views) + view_of[rows])[order])
    first = np.zeros(len(order), bool)
    first[starts] = True
    dropped["observations of a landmark twice in a keyframe"] += int((~first).sum())
    found.label[rows[order[first]]] = ids[landmark[order[first]]]
    return ids, positions
