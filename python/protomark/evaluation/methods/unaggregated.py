"""Every descriptor of every landmark, as an unaggregated map keeps them."""

from __future__ import annotations

from protomark.evaluation.methods.hamming_map import HammingMap
from protomark.evaluation.support import Support


def unaggregated(support: Support) -> HammingMap:
    """All descriptors; a landmark costs its mean number of observations, and one byte for it.

    The byte says how many descriptors follow, which is the least that leads from a row back to
    its landmark.
    """
    observations = len(support.descriptors) / len(support.ids)
    return HammingMap(
        support.descriptors, support.landmarks, observations * support.descriptors.shape[1] + 1
    )
