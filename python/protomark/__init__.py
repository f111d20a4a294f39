"""Protomark: one small integer prototype per landmark instead of all its binary descriptors.

import protomark as pm

encoder = pm.Encoder.load("freak")
scene = pm.PrototypeMap(encoder)
scene.add(landmark_ids, descriptors)
ids, distances = scene.search(new_descriptors, k=2)
"""

from importlib.metadata import version as _version

from protomark._core import (
    Encoder,
    PrototypeMap,
    SealedMap,
    file_journal,
    file_sections,
    hamming_search,
    instruction_set,
    open,
    verify_file,
)
from protomark.errors import FileError
from protomark.upright import upright_descriptors

__version__ = _version("protomark")

__all__ = [
    "Encoder",
    "FileError",
    "PrototypeMap",
    "SealedMap",
    "__version__",
    "file_journal",
    "file_sections",
    "hamming_search",
    "instruction_set",
    "open",
    "upright_descriptors",
    "verify_file",
]
