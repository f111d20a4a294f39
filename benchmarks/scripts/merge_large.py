"""Times the merge of two random maps in different worlds that have landmarks in common.

python benchmarks/scripts/merge_large.py [--landmarks 1000000] [--common 0.2] [--threads 2]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

import protomark as pm
from protomark.geometry.similarity import Similarity
from protomark.maps.merge import merge_files


def peak() -> int:
    """The most memory that this process has had, bytes; `getrusage` counts its parent's."""
    (line,) = (s for s in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in s)
    return 1024 * int(line.split()[1])


def merged(paths: list[Path], output: Path, threads: int) -> tuple[dict[str, Any], float, int]:
    """Facts of the second map, seconds, and bytes, in a process that does nothing else."""
    started, before = time.perf_counter(), peak()
    facts = merge_files(paths, output, threads=threads).facts["inputs"][1]
    return facts, time.perf_counter() - started, peak() - before


def main() -> None:
    """Make two maps, merge them and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--landmarks", type=int, default=1_000_000)
    parser.add_argument("--common", type=float, default=0.2, help="share of the landmarks in both")
    parser.add_argument("--dim", type=int, default=48)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    rng = np.random.default_rng(0)
    n, common, dim = args.landmarks, round(args.common * args.landmarks), args.dim
    encoder = pm.Encoder.load("akaze")
    codes = rng.normal(0, 40, (2 * n - common, dim)).round().clip(-127, 127).astype(np.int8)
    positions = rng.uniform(-1, 1, (len(codes), 3)) * [500, 500, 20]
    positions[: n - common, 0] -= 500  # what only one map holds lies to its side
    positions[n:, 0] += 500
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    motion = Similarity(2.5, turn, np.array([100.0, 20.0, 5.0]))
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{name}.pmk" for name in "ab"]
        for path, begin in zip(paths, (0, n - common), strict=True):
            scene = pm.PrototypeMap(encoder, dim, 5)
            ids = np.arange(n)
            for _ in range(3):
                seen = codes[begin : begin + n] + rng.normal(0, 15, (n, dim))
                scene.add_codes(ids, seen.round().clip(-127, 127).astype(np.int8))
            at = positions[begin : begin + n] + rng.normal(0, 0.05, (n, 3))
            scene.set_positions(ids, motion.inverse()(at) if begin else at)
            scene.save(path)
            print(f"{path.name}: {path.stat().st_size / n:.0f} bytes per landmark")
            del scene, seen
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            work = pool.submit(merged, paths, Path(folder) / "merged.pmk", args.threads)
            facts, seconds, memory = work.result()
    print(
        f"{seconds:.1f} s, {facts['in_common']:,} of {common:,} common landmarks merged, memory "
        f"{memory / 1e9:.2f} GB, {memory / (2 * n):.0f} bytes per landmark of both maps"
    )
    print(facts["moved"])


if __name__ == "__main__":
    main()
