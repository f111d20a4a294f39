"""Reads data sets of OpenMVG: sfm_data with the features of the images.

A keypoint is a line of a `.feat` (x, y, scale, orientation in radians, (0, 0) being the centre of
the first pixel), its descriptor a row of a `.desc`: 64 bytes for AKAZE_MLDB, of which 61 are used.
"""

from __future__ import annotations

import re
from collections import Counter
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from protomark.features.descriptors import descriptor_kind
from protomark.features.extractor import Features
from protomark.files import hash_files, natural_key
from protomark.tracks.file import Tracks
from protomark.tracks.importers.binary import Reader
from protomark.tracks.importers.binary_descriptors import refusal
from protomark.tracks.importers.keyframes import Keyframe, checked_features, join, unexpected
from protomark.tracks.importers.openmvg_scene import VERSIONS, Scene, read_scene

PROGRAM = "OpenMVG"

_ROW = 64  # bytes that a descriptor of AKAZE_MLDB takes in a .desc
_NAMES = ("sfm_data*.bin", "sfm_data*.json")


def recognizes(path: Path, head: bytes) -> bool:
    """Whether a folder, or a file that begins with `head`, is OpenMVG's."""
    if path.is_dir():
        return bool(_scenes(path))
    binary = {b"\1\3" + bytes(7) + version.encode() for version in VERSIONS}
    return head[:12] in binary or (head[:1] == b"{" and b'"sfm_data_version"' in head)


def read(path: Path) -> Tracks:
    """Read an sfm_data, or the largest one in a folder and its folders.

    Features are beside it, or in a folder there or beside that, as `matches/` is.

    Raises:
        FileNotFoundError: there is no sfm_data.
        ValueError: the descriptors are not AKAZE_MLDB or absent, or a file is broken.
    """
    scenes = _scenes(path) if path.is_dir() else [path]
    if not scenes or not scenes[-1].is_file():
        raise FileNotFoundError(f"{path}: no sfm_data of {PROGRAM}")
    file = scenes[-1]
    scene = read_scene(file)
    if not scene.landmark_ids:
        raise ValueError(f"{file}: an sfm_data without landmarks: give that of the reconstruction")
    folder = _features_folder(file, scene)
    files = [file]
    dropped: Counter[str] = Counter()
    labels = _labels(scene)
    keyframes = []
    for view, (name, camera, pose) in sorted(
        scene.views.items(), key=lambda item: natural_key(item[1][0])
    ):
        feat, desc = (folder / (_base(name) + suffix) for suffix in (".feat", ".desc"))
        if camera not in scene.cameras or pose not in scene.poses:
            dropped["keyframes without pose or camera"] += 1
            continue
        if not feat.is_file() or not desc.is_file():
            dropped["keyframes without features"] += 1
            continue
        with unexpected(desc, "features"):
            features = _features(feat, desc)
            rows, ids = labels.get(view, (np.zeros(0, np.int64), np.zeros(0, np.int64)))
            label = np.full(len(features), -1, np.int64)
            label[rows] = ids
        files += [feat, desc]
        keyframes.append(Keyframe(name, camera + 1, scene.poses[pose], features, label))
    source = {
        **{"program": PROGRAM, "version": scene.version, "dropped": dict(dropped)},
        "digest": hash_files((f.name, f) for f in files),
    }
    info = {"source": source, "detector": {"name": "AKAZE"}}
    cameras = {number + 1: camera for number, camera in scene.cameras.items()}
    landmarks = np.array(scene.landmark_ids), np.array(scene.positions)
    return join(file, "akaze", cameras, keyframes, landmarks, info)


def _scenes(folder: Path) -> list[Path]:
    """All sfm_data below a folder, the smallest first: those of parts have no landmarks."""
    found = [f for place in ("", "*/") for name in _NAMES for f in folder.glob(place + name)]
    return sorted((f for f in found if f.is_file()), key=lambda f: f.stat().st_size)


def _features_folder(file: Path, scene: Scene) -> Path:
    """The folder with the features of a scene, which are AKAZE_MLDB's."""
    here = file.parent
    names = [_base(name) + ".desc" for name, *_ in scene.views.values()]
    places = [here, *sorted(here.glob("*/")), here.parent, *sorted(here.parent.glob("*/"))]
    for folder in places:
        found = next((folder / name for name in names if (folder / name).is_file()), None)
        if found is None:
            continue
        kind = _describer(folder)
        if not kind:
            with found.open("rb") as start:
                count = int.from_bytes(start.read(8), "little")
            rest = found.stat().st_size - 8
            kind = "AKAZE_MLDB" if rest == _ROW * count else f"{rest // max(count, 1)}-byte"
        if "MLDB" in kind.upper() or "AKAZE_BINARY" in kind.upper():
            return folder
        raise refusal(file, PROGRAM, [kind])
    raise ValueError(
        f"{file}: the features of its {len(scene.views)} images (.feat and .desc) are neither "
        "beside it nor in a folder there: copy them there, or describe the images anew with "
        "`protomark build images/ sparse/`, where sparse/ is this model exported to COLMAP"
    )


def _base(name: str) -> str:
    """The name of an image's features, without a suffix."""
    return Path(name.replace("\\", "/")).stem or "image"


def _describer(folder: Path) -> str:
    """What image_describer.json says that described the images, "" if nothing."""
    with suppress(OSError, UnicodeDecodeError):
        text = (folder / "image_describer.json").read_text()
        names = re.findall(r'"polymorphic_name":\s*"([\w ]{1,60})"', text)
        return names[-1] if names else ""
    return ""


def _labels(scene: Scene) -> dict[int, tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Rows of features and the landmarks that they observe, by view."""
    views, landmarks = np.array(scene.view_ids, np.int64), np.array(scene.landmarks, np.int64)
    features = np.array(scene.features, np.int64)
    order = np.argsort(views, kind="stable")
    numbers, starts = np.unique(views[order], return_index=True)
    parts = np.split(order, starts[1:])
    return {
        int(number): (features[part], landmarks[part])
        for number, part in zip(numbers, parts, strict=True)
    }


def _features(feat: Path, desc: Path) -> Features:
    reader = Reader(desc.read_bytes(), desc)
    rows = reader.array(np.uint8, reader.count(_ROW), _ROW)
    if len(reader):
        reader.fail(f"{len(reader):,} bytes follow the descriptors")
    words = feat.read_bytes().split()
    numbers = np.array(words, np.float64).reshape(-1, 4)
    used = rows[:, : descriptor_kind("akaze").bytes].copy()
    angles = np.degrees(numbers[:, 3]) % 360
    return checked_features(numbers[:, :2] + 0.5, used, 2 * numbers[:, 2], angles)
