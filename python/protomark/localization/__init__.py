"""Where images were taken, in a map of prototypes."""

from protomark.localization.frustum import PosePrior
from protomark.localization.localizer import Localizer
from protomark.localization.solve import Localization

__all__ = ["Localization", "Localizer", "PosePrior"]
