"""What encoding costs."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import protomark as pm

_DESCRIPTORS, _ROUNDS = 20_000, 5


def encode_nanoseconds(encoder: pm.Encoder) -> float:
    """Nanoseconds to encode one descriptor to full length on one thread, the best of five rounds.

    Random descriptors, 20,000 at a time. Time of the processor, so that other work on the machine
    adds little.
    """
    rng = np.random.default_rng(0)
    descriptors = rng.integers(0, 256, (_DESCRIPTORS, encoder.bits // 8), np.uint8)
    seconds = []
    for _ in range(_ROUNDS):
        began = time.process_time()
        encoder.encode(descriptors, threads=1)
        seconds.append(time.process_time() - began)
    return 1e9 * min(seconds) / _DESCRIPTORS
