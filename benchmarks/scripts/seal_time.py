"""Times the seal of large maps, and what tuning brings there.

python benchmarks/scripts/seal_time.py TRACKS... [--landmarks 1000000]

The map has synthetic landmarks of 4 observations (see `protomark_bench.speed.landmarks`), 48
numbers, 5 bits of appearances and an index, and is sealed to 25 bytes per landmark, one prototype
of each, on two threads.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

import protomark as pm
from protomark_bench.report import ReportTable
from protomark_bench.speed.landmarks import RealLandmarks, SyntheticLandmarks

THREADS = 2
_OBSERVATIONS = 4
_QUERIES = 10_000


def main() -> None:
    """Prints the table of docs/results/large-maps.md."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tracks", type=Path, nargs="+", help="of one descriptor")
    parser.add_argument("--landmarks", type=int, default=1_000_000)
    args = parser.parse_args()
    real = RealLandmarks.load(args.tracks)
    encoder = pm.Encoder.load(real.descriptor)
    synthetic = SyntheticLandmarks(real, encoder, 48, observations=_OBSERVATIONS, threads=THREADS)
    ids = np.repeat(np.arange(args.landmarks), _OBSERVATIONS)
    descriptors = synthetic.descriptors(args.landmarks)
    scene = pm.PrototypeMap(encoder, 48, appearance_bits=5)
    scene.add(ids, descriptors, threads=THREADS)
    scene.build_index(threads=THREADS)
    asked = np.random.default_rng(0).choice(args.landmarks, _QUERIES)
    queries = synthetic.queries(asked)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, observed, tune in (
            ("not tuned", (None, None), False),
            ("tuned by appearances", (None, None), True),
            ("tuned by observations", (ids, descriptors), True),
        ):
            began = time.perf_counter()
            sealed = scene.seal(
                Path(folder) / "s.pmk",
                *observed,
                bytes_per_landmark=25,
                position_bits=0,
                tune=tune,
                threads=THREADS,
            )
            seconds = time.perf_counter() - began
            cells = [name, f"{seconds:.0f} s"]
            for recall in (None, 0.99):
                found, _ = sealed.search(queries, k=1, recall=recall, threads=THREADS)
                cells.append(f"{(found[:, 0] == asked).mean():.3f}")
            rows.append([*cells, f"{sealed.nprobe(0.99):,} of {sealed.nlist:,}"])
    heads = ["prototypes", "time to seal", "precision", "with recall 0.99", "lists for that"]
    print(ReportTable(heads, rows).markdown())


if __name__ == "__main__":
    main()
