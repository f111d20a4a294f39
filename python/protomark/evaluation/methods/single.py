"""One of a landmark's own descriptors, chosen without looking at them."""

from __future__ import annotations

import numpy as np

from protomark.evaluation.methods.hamming_map import HammingMap
from protomark.evaluation.support import Support


def first_seen(support: Support) -> HammingMap:
    """The descriptor of the earliest keyframe."""
    return HammingMap(
        support.descriptors[support.starts], support.ids, support.descriptors.shape[1]
    )


def random_sample(support: Support) -> HammingMap:
    """A descriptor drawn at random."""
    rng = np.random.default_rng(support.seed)
    rows = support.starts + rng.integers(0, support.counts)
    return HammingMap(support.descriptors[rows], support.ids, support.descriptors.shape[1])
