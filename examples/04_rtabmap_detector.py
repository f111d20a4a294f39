"""RTAB-Map's words as codes of 32 numbers: a detector for its PyDetector, which needs no change.

    rtabmap --Kp/DetectorStrategy 15 --Vis/FeatureType 15 \
        --PyDetector/Path /path/to/04_rtabmap_detector.py

A word takes 128 bytes (32 float32 numbers), where SuperPoint's takes 1,024. RTAB-Map must be built
with Python, and that Python must have protomark[localize].
"""

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.features.extractor import Extractor

DIM = 32
MAX_KEYPOINTS = 1000  # RTAB-Map takes the strongest ones: Kp/MaxFeatures, Vis/MaxFeatures

extractor: Extractor
encoder: pm.Encoder


def init(cuda: int) -> None:
    """Load the encoder; it runs on the CPU, whatever PyDetector/Cuda says."""
    global extractor, encoder
    extractor, encoder = Extractor("freak", MAX_KEYPOINTS), pm.Encoder.load("freak")


def detect(image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return keypoints (n, 3), as x, y and strength, and their codes (n, 32)."""
    found = extractor(np.ascontiguousarray(image))
    # RTAB-Map's pixels have their centres at whole numbers.
    keypoints = np.column_stack([found.keypoints - 0.5, found.responses])
    codes = encoder.encode(found.descriptors, DIM)
    return keypoints.astype(np.float32, "C"), codes.astype(np.float32, "C")


if __name__ == "__main__":
    import sys
    from pathlib import Path

    from protomark.features.images import read_gray

    init(0)
    for path in sys.argv[1:]:
        keypoints, codes = detect(read_gray(Path(path)))
        print(f"{path}: {len(keypoints)} keypoints, {codes.nbytes:,} bytes of codes")
