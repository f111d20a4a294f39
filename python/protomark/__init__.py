"""Protomark: one small integer prototype per landmark instead of all its binary descriptors.

import protomark as pm

encoder = pm.Encoder.load("freak")
scene = pm.PrototypeMap(encoder)
scene.add(landmark_ids, descriptors)
ids, distances = scene.search(new_descriptors, k=2)
"""

from importlib.metadata import version as _version
from typing import TYPE_CHECKING

from protomark._core import (
    PrototypeMap,
    SealedMap,
    file_journal,
    file_sections,
    hamming_search,
    instruction_set,
    open,
    verify_file,
)
from protomark.encoders import Encoder
from protomark.errors import FileError
from protomark.sized import sized_descriptors
from protomark.upright import upright_descriptors

if TYPE_CHECKING:
    from protomark.localization import Localizer as Localizer
    from protomark.matching import match as match

__version__ = _version("protomark")

__all__ = [
    "Encoder",
    "FileError",
    "Localizer",
    "PrototypeMap",
    "SealedMap",
    "__version__",
    "file_journal",
    "file_sections",
    "hamming_search",
    "instruction_set",
    "match",
    "open",
    "sized_descriptors",
    "upright_descriptors",
    "verify_file",
]

# What search alone does not need is imported when it is first asked for.
_LATER = {"Localizer": "protomark.localization", "match": "protomark.matching"}


def __getattr__(name: str) -> object:
    if name in _LATER:
        from importlib import import_module

        return getattr(import_module(_LATER[name]), name)
    raise AttributeError(f"module 'protomark' has no attribute {name!r}")
