"""Loads bundled encoders by name."""

from __future__ import annotations

import os

from protomark._core import Encoder as Encoder
from protomark.models import resolve

_load_file = Encoder.load


def load(source: str | os.PathLike[str]) -> Encoder:
    """Load an encoder: one that ships, by its name such as "freak", or a model file, by its path.

    Raises:
        FileNotFoundError: there is no such model.
        FileError: the file is not a model, or it is broken.
    """
    return _load_file(resolve(source))


# The stub of the core declares it (bindings/stub_patterns.txt).
setattr(Encoder, "load", staticmethod(load))  # noqa: B010
