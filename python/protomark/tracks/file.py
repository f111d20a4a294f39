"""Reads and writes tracks: the keyframes, keypoints, descriptors and landmarks of a sequence.

A tracks file is a safetensors file. Every array below is a tensor of the same name; cameras, image
names and `info` are JSON in the file's metadata.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from protomark.extras import optional
from protomark.features.descriptors import DESCRIPTORS, VECTOR_SIZES, InputKind
from protomark.features.extractor import FEATURE_ARRAYS, Features
from protomark.features.upright import SUFFIX, upright_descriptors
from protomark.files import is_utf8, replacing
from protomark.geometry.camera import Camera, cameras_from_json

if TYPE_CHECKING:
    from protomark.geometry.colmap import ColmapModel

FORMAT = "protomark-tracks"
VERSION = 1

# Dtypes and shapes, with m keyframes, n keypoints, l landmarks, b bytes per descriptor.
ARRAYS: dict[str, tuple[type, tuple[str | int, ...]]] = {
    "keyframe_camera": (np.int32, ("m",)),
    "cam_from_world": (np.float64, ("m", 3, 4)),
    "offsets": (np.int64, ("m+1",)),
    "keypoints": (np.float32, ("n", 2)),
    "sizes": (np.float32, ("n",)),
    "angles": (np.float32, ("n",)),
    "responses": (np.float32, ("n",)),
    "octaves": (np.int32, ("n",)),
    "descriptors": (np.uint8, ("n", "b")),
    "landmark_of_keypoint": (np.int64, ("n",)),
    "landmark_ids": (np.int64, ("l",)),
    "landmark_positions": (np.float64, ("l", 3)),
}
# Dtypes of descriptors by what they are.
INPUTS: dict[str, type] = {"bits": np.uint8, "uint8": np.uint8, "float32": np.float32}


@dataclass
class Tracks:
    """All observations of one sequence: m keyframes, n keypoints, l landmarks.

    Poses and pixels follow COLMAP: `cam_from_world` maps world to camera coordinates, and the
    centre of the upper left pixel is (0.5, 0.5).

    Attributes:
        descriptor: name of the descriptor, such as "freak".
        cameras: cameras by COLMAP's id.
        keyframe_names: m image names.
        keyframe_camera: (m,) int32, camera id of each keyframe.
        cam_from_world: (m, 3, 4) float64, rotation and translation.
        offsets: (m + 1,) int64; the keypoints of keyframe i are rows offsets[i]:offsets[i + 1].
        keypoints: (n, 2) float32, x and y in pixels.
        sizes: (n,) float32, diameter of the keypoint in pixels.
        angles: (n,) float32, orientation in degrees, clockwise, [0, 360), -1 where there is none.
        responses: (n,) float32, the detector's strength.
        octaves: (n,) int32, the detector's pyramid level.
        descriptors: (n, b), in OpenCV's bytes: uint8 of bits, or vectors of uint8 or float32.
        landmark_of_keypoint: (n,) int64, landmark id of each keypoint, -1 where there is none.
        landmark_ids: (l,) int64, ascending.
        landmark_positions: (l, 3) float64, in world coordinates.
        info: what the tracks were made from, and how (JSON values). "source" has the program, its
            version, a digest of its file, the maps in that, and counts of what was "dropped";
            "detector" has the name and the settings of what described the images.
        input: what the descriptors are: "bits", "uint8" or "float32".
    """

    descriptor: str
    cameras: dict[int, Camera]
    keyframe_names: list[str]
    keyframe_camera: NDArray[np.int32]
    cam_from_world: NDArray[np.float64]
    offsets: NDArray[np.int64]
    keypoints: NDArray[np.float32]
    sizes: NDArray[np.float32]
    angles: NDArray[np.float32]
    responses: NDArray[np.float32]
    octaves: NDArray[np.int32]
    descriptors: NDArray[Any]
    landmark_of_keypoint: NDArray[np.int64]
    landmark_ids: NDArray[np.int64]
    landmark_positions: NDArray[np.float64]
    info: dict[str, Any] = field(default_factory=dict)
    input: InputKind = "bits"

    @classmethod
    def from_features(
        cls,
        descriptor: str,
        model: ColmapModel,
        features: Sequence[Features],
        landmark_of_keypoint: NDArray[np.int64],
        positions: NDArray[np.float64],
        info: dict[str, Any],
    ) -> Tracks:
        """The tracks of a model's images.

        Args:
            descriptor: name of the descriptor.
            model: cameras and m poses.
            features: m keyframes' keypoints.
            landmark_of_keypoint: (n,) rows of `positions`, -1 where there is none.
            positions: (l, 3) landmarks, whose ids are 0 to l - 1.
            info: what the tracks were made from, and how.
        """
        tracks = cls(
            descriptor=descriptor,
            cameras=model.cameras,
            keyframe_names=model.names,
            keyframe_camera=model.camera_ids,
            cam_from_world=np.ascontiguousarray(model.cam_from_world),
            offsets=np.cumsum([0, *map(len, features)], dtype=np.int64),
            **{k: np.concatenate([getattr(f, k) for f in features]) for k in FEATURE_ARRAYS},
            landmark_of_keypoint=landmark_of_keypoint,
            landmark_ids=np.arange(len(positions), dtype=np.int64),
            landmark_positions=positions,
            info=info,
            input=DESCRIPTORS[descriptor].input if descriptor in DESCRIPTORS else "bits",
        )
        tracks.check()
        return tracks

    @property
    def bits(self) -> int:
        """Length of a descriptor in bits."""
        return 8 * int(self.descriptors.shape[1]) * self.descriptors.itemsize

    @property
    def width(self) -> int:
        """How many numbers a descriptor has: bits, or those of a vector."""
        return self.bits if self.input == "bits" else int(self.descriptors.shape[1])

    @property
    def encoder_name(self) -> str:
        """Name of the encoder that ships for what described the images."""
        detectors = self.info.get("detectors", [self.info.get("detector", {})])
        return shipped_encoder(self.descriptor, detectors)

    @property
    def keyframe_of_keypoint(self) -> NDArray[np.int64]:
        """(n,) int64, index of each keypoint's keyframe."""
        return np.repeat(np.arange(len(self.keyframe_names)), np.diff(self.offsets))

    @property
    def observations(self) -> NDArray[np.int64]:
        """Rows of the keypoints that observe a landmark."""
        return np.flatnonzero(self.landmark_of_keypoint >= 0)

    def keypoints_of(self, keyframe: int) -> slice:
        """The rows of a keyframe's keypoints."""
        return slice(int(self.offsets[keyframe]), int(self.offsets[keyframe + 1]))

    def where(self, keep: NDArray[np.bool_]) -> Tracks:
        """The tracks with the keypoints for which `keep` (n,) is true, and with all landmarks."""
        counts = np.bincount(self.keyframe_of_keypoint[keep], minlength=len(self.keyframe_names))
        rows = {name: getattr(self, name)[keep] for name, (_, s) in ARRAYS.items() if s[0] == "n"}
        offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        return replace(self, offsets=offsets, **rows)

    def upright(self) -> Tracks:
        """The tracks with angles and sizes in the descriptors, named `<descriptor>-upright`.

        Raises:
            ValueError: no keypoint has an angle, or the descriptors are vectors.
        """
        if self.input != "bits":
            raise ValueError(
                f"{self.descriptor} has no upright form, as it is a vector: take the plain encoder"
            )
        if not (self.angles >= 0).any():
            raise ValueError(
                f"no keypoint of these {self.descriptor} tracks has an angle, which upright "
                "encoders need: take the plain encoder"
            )
        return replace(
            self,
            descriptor=self.descriptor + SUFFIX,
            descriptors=upright_descriptors(self.descriptors, self.angles, self.sizes),
        )

    def positions_of(self, landmark_ids: NDArray[np.int64]) -> NDArray[np.float64]:
        """Positions (n, 3) of landmarks (n,)."""
        return self.landmark_positions[np.searchsorted(self.landmark_ids, landmark_ids)]

    def check(self) -> None:
        """Raise ValueError if shapes, types or indices do not fit together."""
        names = self.keyframe_names
        if not isinstance(names, list) or not all(map(_is_text, names)):
            raise ValueError("tracks: keyframe_names are not a list of texts")
        if not _is_text(self.descriptor):
            raise ValueError("tracks: descriptor is not a text")
        if self.input not in INPUTS:
            raise ValueError(f"tracks: input {self.input!r} is none of {', '.join(INPUTS)}")
        named = DESCRIPTORS.get(self.descriptor)
        if named and named.input != self.input:
            raise ValueError(
                f"tracks: {self.descriptor} descriptors are {named.input}, not {self.input}: "
                f"give input={named.input!r}"
            )
        sizes = {
            "m": len(self.keyframe_names),
            "m+1": len(self.keyframe_names) + 1,
            "n": len(self.keypoints),
            "l": len(self.landmark_ids),
            "b": self.descriptors.shape[1] if self.descriptors.ndim == 2 else 0,
        }
        types = array_types(self.input)
        for name, (_, shape) in ARRAYS.items():
            array, dtype = getattr(self, name), types[name]
            want = tuple(sizes[s] if isinstance(s, str) else s for s in shape)
            if array.dtype != dtype or array.shape != want:
                raise ValueError(
                    f"tracks: {name} is {array.dtype} {array.shape}, "
                    f"expected {np.dtype(dtype)} {want}"
                )
        ids, offsets = self.landmark_ids, self.offsets
        seen = self.landmark_of_keypoint[self.landmark_of_keypoint != -1]
        floats = [name for name, dtype in types.items() if issubclass(dtype, np.floating)]
        endless = [name for name in floats if not np.isfinite(getattr(self, name)).all()]
        runs = offsets[0] == 0 and offsets[-1] == sizes["n"] and (np.diff(offsets) >= 0).all()
        lacking = [int(i) for i in self.keyframe_camera if int(i) not in self.cameras]
        has_texts = isinstance(self.info, dict) and _is_text(
            json.dumps(self.info, ensure_ascii=False)
        )
        empty = np.flatnonzero(~self.descriptors.any(axis=1) & (self.input != "bits"))
        for wrong, problem in (
            (sizes["b"] < 1, "descriptors have no bytes"),
            (
                self.input != "bits" and sizes["b"] not in VECTOR_SIZES,
                f"vectors have {sizes['b']} numbers, not {VECTOR_SIZES[0]} to {VECTOR_SIZES[-1]}",
            ),
            (len(empty), f"descriptor {empty[:1]} is a vector of zeros: leave its keypoint out"),
            (not runs, "offsets do not run from 0 to the number of keypoints"),
            ((np.diff(ids) <= 0).any(), "landmark_ids are not strictly ascending"),
            ((ids[:1] < 0).any(), "landmark_ids contains a negative id"),
            (
                not np.isin(seen, ids).all(),
                "landmark_of_keypoint names a landmark that landmark_ids lacks",
            ),
            (endless, f"{', '.join(endless)} contains NaN or infinity"),
            (not has_texts, "info is not a JSON object of texts and numbers"),
            (lacking, f"a keyframe names camera {lacking[:1]}, which is missing"),
        ):
            if wrong:
                raise ValueError(f"tracks: {problem}")
        for number, c in self.cameras.items():
            try:
                c.check()
            except ValueError as error:
                raise ValueError(f"tracks: camera {number}: {error}") from None

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the file atomically."""
        save = optional("safetensors.numpy").save
        self.check()
        header = {
            "format": FORMAT,
            "version": str(VERSION),
            "descriptor": self.descriptor,
            **({} if self.input == "bits" else {"input": self.input}),
            "cameras": json.dumps({str(k): c.as_dict() for k, c in self.cameras.items()}),
            "keyframe_names": json.dumps(self.keyframe_names),
            "info": json.dumps(self.info),
        }
        arrays = {name: np.ascontiguousarray(getattr(self, name)) for name in ARRAYS}
        with replacing(path) as file:
            file.write(save(arrays, metadata=header))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Tracks:
        """Read and check a tracks file.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is not a tracks file, or it is broken.
        """
        safetensors = optional("safetensors")
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such tracks file")
        try:
            with safetensors.safe_open(path, framework="numpy") as file:
                fields = header_fields(file.metadata() or {})
                missing = set(ARRAYS) - set(file.keys())
                if missing:
                    raise ValueError(f"tracks file lacks {', '.join(sorted(missing))}")
                arrays = {name: file.get_tensor(name) for name in ARRAYS}
            tracks = cls(**fields, **arrays)
            tracks.check()
        except safetensors.SafetensorError as error:
            from protomark.tracks.importers import check_own

            check_own(path, "tracks {} -o tracks")
            raise ValueError(f"{path}: not a tracks file, or a broken one ({error})") from None
        except (KeyError, TypeError, OverflowError, RecursionError) as error:
            raise ValueError(f"{path}: broken tracks file ({error!r})") from None
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        return tracks


def header_fields(header: dict[str, str]) -> dict[str, Any]:
    """The attributes of `Tracks` that a file keeps as text; raises ValueError or KeyError."""
    if header.get("format") != FORMAT:
        raise ValueError("a safetensors file, but not a Protomark tracks file")
    _check_version(header["version"])
    named = DESCRIPTORS.get(header["descriptor"])
    kind = header.get("input", named.input if named else "bits")
    if kind not in INPUTS:
        raise ValueError(f"tracks of {kind!r}: this Protomark knows {', '.join(INPUTS)}")
    return {
        "descriptor": header["descriptor"],
        "cameras": cameras_from_json(_json(header, "cameras")),
        "keyframe_names": _json(header, "keyframe_names"),
        "info": _json(header, "info"),
        "input": kind,
    }


def array_types(kind: InputKind) -> dict[str, type]:
    """The dtype of each array of tracks with such descriptors."""
    return {name: dtype for name, (dtype, _) in ARRAYS.items()} | {"descriptors": INPUTS[kind]}


def shipped_encoder(descriptor: str, detectors: Sequence[dict[str, Any]]) -> str:
    """Name of the encoder that ships for a descriptor at the keypoints of these detectors."""
    corners = all(str(one.get("name")).startswith("GFTT") for one in detectors)
    return "orb-gftt" if corners and descriptor == "orb" else descriptor


def _check_version(text: str) -> None:
    if not re.fullmatch("[1-9][0-9]{0,8}", text):
        raise ValueError(f"tracks files have no version {text[:20]!r}")
    if int(text) > VERSION:
        raise ValueError(f"tracks version {text}: this Protomark reads up to {VERSION}, update it")


def _json(header: dict[str, str], name: str) -> Any:
    try:
        return json.loads(header[name])
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{name} cannot be read as JSON ({error})") from None


def _is_text(value: Any) -> bool:
    # JSON may contain lone surrogates, which cannot be written or printed.
    return isinstance(value, str) and is_utf8(value)


def sequence_name(path: Path) -> str:
    """The name of a sequence: its file name up to the first dot."""
    return path.name.split(".")[0] or path.name
