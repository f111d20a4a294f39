"""Localizes images in a map."""

from protomark.localization.localizer import Localizer
from protomark.localization.prior import PosePrior
from protomark.localization.solve import Localization

__all__ = ["Localization", "Localizer", "PosePrior"]
