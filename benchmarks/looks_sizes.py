"""Which dimensions are the most precise in a number of bytes, when landmarks have several looks.

python benchmarks/looks_sizes.py TRACKS [--look-bits 8 10 12]

Prints precision by bytes and dimensions, of 4-bit maps of the encoder that ships; on a validation
sequence this picked what `protomark evaluate` compares as looks-17, looks-33 and looks-65.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import protomark as pm
from protomark.console import console
from protomark.evaluation.methods.prototypes import looks, prototypes_in
from protomark.evaluation.protocol import split
from protomark.evaluation.support import Support
from protomark.tracks.file import Tracks

SIZES = (17, 33, 65)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tracks", type=Path)
    parser.add_argument("--look-bits", type=int, nargs="+", default=[10])
    asked = parser.parse_args()
    tracks = Tracks.load(asked.tracks)
    encoder = pm.Encoder.load(tracks.descriptor)
    part = split(tracks, 0)
    support = Support(
        tracks.landmark_of_keypoint[part.support_rows], tracks.descriptors[part.support_rows]
    )
    queries = tracks.descriptors[part.query_rows]
    true = tracks.landmark_of_keypoint[part.query_rows]
    for look_bits in asked.look_bits:
        for size in SIZES:
            found = []
            for dim in encoder.dims:
                if dim < look_bits or prototypes_in(size, dim) < 1:
                    continue
                ids, _ = looks(support, encoder, dim, look_bits, size).match(queries)
                found.append(f"{dim}: {(ids[:, 0] == true).mean():.4f}")
            console.print(f"{look_bits} signs, {size} bytes  " + "  ".join(found), highlight=False)


if __name__ == "__main__":
    main()
