"""Writes tracks as RTAB-Map does, in the schema of several versions."""

from __future__ import annotations

import sqlite3
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.pose import compose, inverse, transform
from protomark.tracks.file import Tracks

# Without sizes and descriptors of features; without octaves; and so on.
VERSIONS = ("0.11.0", "0.11.10", "0.12.0", "0.17.0", "0.18.0", "0.23.0")
# The robot's base looks along x, its camera along z.
OPTICAL = np.array([[0.0, 0.0, 1.0, 0.05], [-1.0, 0.0, 0.0, 0.01], [0.0, -1.0, 0.0, 0.3]])
PARAMETERS = "Kp/DetectorStrategy:{};Kp/MaxFeatures:500;GFTT/QualityLevel:0.001;ORB/NLevels:3;"


def motion(pose: NDArray[np.float64]) -> bytes:
    return pose.astype("<f4").tobytes()


def matrix(values: NDArray[Any]) -> bytes:
    """A compressed cv::Mat."""
    kind = 4 if values.dtype.kind == "i" else 5
    return zlib.compress(values.tobytes()) + struct.pack("<3i", *values.shape, kind)


def calibration(tracks: Tracks, motions: list[NDArray[np.float64]], version: str) -> bytes:
    camera = next(iter(tracks.cameras.values()))
    fx, fy, cx, cy = camera.params
    size = (camera.width, camera.height)
    out = b""
    for base_from_cam in motions:
        pinhole = [fx, fy, cx - 0.5, cy - 0.5]
        if VERSIONS.index(version) < 4:
            numbers = [*pinhole, *(size if version != VERSIONS[0] else ())]
            out += np.array(numbers, "<f4").tobytes() + motion(base_from_cam)
            continue
        k = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
        p = np.column_stack([k, np.zeros(3)])
        # Images are rectified, whatever the lens was and its K.
        out += struct.pack("<11i", 0, 21, 10, 0, *size, 9, 5, 9, 12, 12)
        out += (k * 1.1).tobytes() + np.full(5, 0.3).tobytes()
        out += np.eye(3).tobytes() + p.tobytes() + motion(base_from_cam)
    return out


def stereo_calibration(tracks: Tracks, version: str) -> bytes:
    """A stereo camera, of which features are the left one's."""
    left = calibration(tracks, [OPTICAL], version)
    if VERSIONS.index(version) >= 4:
        head = struct.pack("<10i", 0, 21, 10, 1, 9, 3, 0, 0, len(left), len(left))
        return head + np.eye(3).tobytes() + np.array([-0.1, 0, 0]).tobytes() + 2 * left
    return left[:16] + struct.pack("<f", 0.1) + left[16:]


def write_rtabmap(
    path: Path,
    tracks: Tracks,
    version: str = VERSIONS[-1],
    cameras: int = 1,
    *,
    strategy: int = 8,
    sessions: int = 1,
    drift: NDArray[np.float64] | None = None,
    stereo: bool = False,
) -> None:
    """Write a database with a node for each `cameras` keyframes.

    Landmarks have the ids of their words, from 1 on. With a `drift` of the odometry, all nodes but
    the last one are in the optimized graph.
    """
    age = VERSIONS.index(version)
    table = "Feature" if age >= 3 else "Map_Node_Word"
    octave = "octave INTEGER, " if age >= 2 else ""
    described = "descriptor_size INTEGER, descriptor BLOB, " if age >= 1 else ""
    has_graph = age >= 3
    graph = ", opt_ids BLOB, opt_poses BLOB" if has_graph else ""
    connection = sqlite3.connect(path)
    connection.executescript(f"""
        CREATE TABLE Node (id INTEGER NOT NULL, map_id INTEGER NOT NULL, weight INTEGER,
            stamp FLOAT, pose BLOB, label TEXT, PRIMARY KEY (id));
        CREATE TABLE Data (id INTEGER NOT NULL, image BLOB, calibration BLOB, PRIMARY KEY (id));
        CREATE TABLE Word (id INTEGER NOT NULL, descriptor_size INTEGER, descriptor BLOB,
            PRIMARY KEY (id));
        CREATE TABLE {table} (node_id INTEGER NOT NULL, word_id INTEGER NOT NULL, pos_x FLOAT,
            pos_y FLOAT, size INTEGER, dir FLOAT, response FLOAT, {octave}depth_x FLOAT,
            depth_y FLOAT, depth_z FLOAT, {described}FOREIGN KEY (node_id) REFERENCES Node(id));
        CREATE TABLE Info (STM_size INTEGER, parameters TEXT);
        CREATE TABLE Admin (version TEXT{graph});
    """)
    width = next(iter(tracks.cameras.values())).width
    words: dict[int, bytes] = {}
    bases = []
    for node in range(len(tracks.keyframe_names) // cameras):
        frames = range(node * cameras, (node + 1) * cameras)
        base = compose(inverse(tracks.cam_from_world[frames[0]]), inverse(OPTICAL))
        bases.append(base)
        motions = [compose(inverse(base), inverse(tracks.cam_from_world[i])) for i in frames]
        odometry = base if drift is None else compose(drift, base)
        session = node * sessions * cameras // len(tracks.keyframe_names)
        row = (node, session, 0, float(node), motion(odometry), "")
        connection.execute("INSERT INTO Node VALUES (?,?,?,?,?,?)", row)
        blob = calibration(tracks, motions, version)
        if stereo:
            blob = stereo_calibration(tracks, version)
        connection.execute("INSERT INTO Data VALUES (?,?,?)", (node, b"\xff\xd8", blob))
        for camera, i in enumerate(frames):
            for r in range(*tracks.keypoints_of(i).indices(len(tracks.keypoints))):
                word = int(tracks.landmark_of_keypoint[r])
                point: list[float | None] = [None] * 3
                if word > 0:
                    point = transform(inverse(base), tracks.positions_of(np.array([word])))[
                        0
                    ].tolist()
                x, y = (tracks.keypoints[r].astype(float) - 0.5).tolist()
                data = tracks.descriptors[r].tobytes()
                values: list[Any] = [node, word, x + camera * width, y, int(tracks.sizes[r])]
                values += [float(tracks.angles[r]), float(tracks.responses[r])]
                values += ([int(tracks.octaves[r])] if octave else []) + point
                values += [len(data), data] if described else []
                marks = ",".join("?" * len(values))
                connection.execute(f"INSERT INTO {table} VALUES ({marks})", values)
                words.setdefault(word, data)
    for word, data in words.items():
        connection.execute("INSERT INTO Word VALUES (?,?,?)", (word, len(data), data))
    connection.execute("INSERT INTO Info VALUES (0, '')")
    connection.execute("INSERT INTO Info VALUES (2, ?)", (PARAMETERS.format(strategy),))
    blobs: tuple[bytes | None, ...] = ()
    if has_graph:
        blobs = (None, None)
        if drift is not None:
            ids = np.arange(len(bases) - 1, dtype="<i4")[None]
            poses = np.array([b.astype("<f4").ravel() for b in bases[:-1]]).reshape(1, -1)
            blobs = (matrix(ids), matrix(poses))
    connection.execute(f"INSERT INTO Admin VALUES (?{', ?' * len(blobs)})", (version, *blobs))
    connection.commit()
    connection.close()
