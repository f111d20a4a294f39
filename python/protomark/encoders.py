"""Encoder methods beyond the core: loading bundled models, and match calibration."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from protomark._core import Encoder as Encoder
from protomark.models import resolve

if TYPE_CHECKING:
    from protomark.match_calibration import MatchCalibration

_load_file = Encoder.load


def load(source: str | os.PathLike[str]) -> Encoder:
    """Load an encoder: one that ships, by its name such as "freak", or a model file, by its path.

    Raises:
        FileNotFoundError: there is no such model.
        FileError: the file is not a model, or it is broken.
    """
    return _load_file(resolve(source))


def match_calibration(self: Encoder, dim: int | None = None) -> MatchCalibration:
    """The calibration that turns distances to the two nearest landmarks into a probability.

    Args:
        self: the encoder.
        dim: length of a code, one of `dims`; None: the full length.

    Raises:
        ValueError: the encoder was not calibrated for codes of this length.
    """
    from protomark.match_calibration import MatchCalibration

    return MatchCalibration.of(self, dim)


# The stub of the core declares both methods (bindings/stub_patterns.txt).
setattr(Encoder, "load", staticmethod(load))  # noqa: B010
setattr(Encoder, "match_calibration", match_calibration)  # noqa: B010
