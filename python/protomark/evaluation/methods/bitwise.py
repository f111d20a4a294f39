"""One binary descriptor a landmark, computed bit by bit."""

from __future__ import annotations

import numpy as np

from protomark.evaluation.methods.hamming_map import HammingMap
from protomark.evaluation.support import Support


def majority(support: Support) -> HammingMap:
    """The mean of each bit, quantised at 0.5; a bit set in exactly half of them is set.

    Other rules for ties (clear, as in the first descriptor, at random) change the precision by
    less than its spread over seeds.
    """
    bits = 2 * support.bit_sums >= support.counts[:, None]
    packed = np.packbits(bits, axis=1, bitorder="little")
    return HammingMap(packed, support.ids, packed.shape[1])


def bitwise_and(support: Support) -> HammingMap:
    """A bit is set where every observation has it set."""
    packed = np.bitwise_and.reduceat(support.descriptors, support.starts, axis=0)
    return HammingMap(packed, support.ids, packed.shape[1])
