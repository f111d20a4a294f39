"""Protomark: visual maps that keep a few small integer prototypes per landmark.

import protomark as pm

encoder = pm.Encoder.load("freak")
scene = pm.PrototypeMap(encoder)
scene.add(landmark_ids, descriptors)
ids, distances = scene.search(new_descriptors, k=2)
"""

from protomark import interrupt as _interrupt  # noqa: F401  (first: see there)

# isort: split
from importlib import import_module as _import_module
from importlib.metadata import version as _version
from typing import TYPE_CHECKING

from protomark._core import (
    FileError,
    PrototypeMap,
    SealedMap,
    file_journal,
    file_sections,
    hamming_search,
    instruction_set,
    verify_file,
)
from protomark.encoders import Encoder
from protomark.maps.open import open_map as open

if TYPE_CHECKING:
    from protomark.features.upright import upright_descriptors as upright_descriptors
    from protomark.geometry.camera import Camera as Camera
    from protomark.localization import Localizer as Localizer
    from protomark.localization import PosePrior as PosePrior
    from protomark.maps.sharded_map import ShardedMap as ShardedMap
    from protomark.matching import match as match

__version__ = _version("protomark")

# Imported when they are first used, so that search alone starts fast and needs NumPy only.
_LAZY = {
    "Camera": "protomark.geometry.camera",
    "Localizer": "protomark.localization",
    "PosePrior": "protomark.localization",
    "ShardedMap": "protomark.maps.sharded_map",
    "match": "protomark.matching",
    "upright_descriptors": "protomark.features.upright",
}

__all__ = [
    "Camera",
    "Encoder",
    "FileError",
    "Localizer",
    "PosePrior",
    "PrototypeMap",
    "SealedMap",
    "ShardedMap",
    "__version__",
    "file_journal",
    "file_sections",
    "hamming_search",
    "instruction_set",
    "match",
    "open",
    "upright_descriptors",
    "verify_file",
]


def __getattr__(name: str) -> object:
    if name in _LAZY:
        return getattr(_import_module(_LAZY[name]), name)
    if name == "distributed":
        return _import_module("protomark.distributed")
    raise AttributeError(f"module 'protomark' has no attribute {name!r}")
