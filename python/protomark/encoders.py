"""Encoders that ship, by name."""

from __future__ import annotations

import os

from protomark._core import Encoder as Encoder
from protomark.models import resolve

_load_file = Encoder.load


def load(source: str | os.PathLike[str]) -> Encoder:
    """Load an encoder by the name of one that ships ("freak", "orb") or the path of a model file.

    Raises:
        FileNotFoundError: there is no such model.
        FileError: the file is not a model.
    """
    return _load_file(resolve(source))


# The stub of the core declares it (bindings/stub_patterns.txt).
setattr(Encoder, "load", staticmethod(load))  # noqa: B010
