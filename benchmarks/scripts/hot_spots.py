"""Samples the functions of the core in which encoding, adding and searching spend their time.

python benchmarks/scripts/hot_spots.py [--landmarks 1000000] [--work encode,add,...]

Linux `perf` samples one thread, a thousand times per second, while it repeats one kind of work on
synthetic landmarks. Functions have names if the package is installed with them:

    pip install . -C cmake.build-type=RelWithDebInfo \
      -C cmake.define.CMAKE_CXX_FLAGS_RELWITHDEBINFO="-O3 -g -DNDEBUG"

An inlined function counts for its caller.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import tempfile
import threading
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np

import protomark as pm
from protomark_bench.report import ReportTable
from protomark_bench.speed.landmarks import RealLandmarks, Workload, map_of

SHOWN = 0.02  # least share of a function that is printed
WORK = ("encode", "add", "exact", "one query", "approximate")


def work(name: str, workload: Workload, landmarks: int) -> Callable[[], object]:
    """The function that does this kind of work."""
    encoder, dim = workload.encoder, workload.dim
    descriptors = workload.queries(landmarks, 20_000)
    if name == "encode":
        return lambda: encoder.encode(descriptors, dim=dim)
    codes = workload.codes(descriptors[:1_000])
    scene = map_of(encoder, workload.prototypes(landmarks))
    if name == "add":
        ids = np.random.default_rng(0).integers(0, landmarks, len(descriptors))
        return lambda: scene.add(ids, descriptors)
    if name == "exact":
        return lambda: scene.search_codes(codes, k=2)
    if name == "one query":
        return lambda: scene.search_codes(codes[:1], k=2)
    scene.build_index(threads=2)
    return lambda: scene.search_codes(codes, k=2, recall=0.98)


def sampled(run: Callable[[], object], seconds: float) -> list[tuple[float, str]]:
    """Share and name of each function while `run` is repeated, the greatest first."""
    ended = threading.Event()

    def repeat() -> None:
        while not ended.is_set():
            run()

    run()
    thread = threading.Thread(target=repeat)
    thread.start()
    with tempfile.TemporaryDirectory() as folder:
        data = str(Path(folder) / "perf.data")
        record = ["perf", "record", "-q", "-e", "cpu-clock", "-F", "1000", "-o", data]
        try:
            command = [*record, "-t", str(thread.native_id), "--", "sleep", str(seconds)]
            subprocess.run(command, check=True)
        finally:
            ended.set()
            thread.join()
        report = ["perf", "report", "-q", "--stdio", "--sort", "symbol", "-i", data]
        text = subprocess.run(report, check=True, capture_output=True, text=True).stdout
    shares: dict[str, float] = defaultdict(float)
    for share, symbol in re.findall(r"^\s*([\d.]+)%\s+\[.\] (.+)$", text, re.MULTILINE):
        name = symbol.replace("(anonymous namespace)::", "")
        ours = re.search(r"protomark::[\w:]+", name)
        short = ours.group().removeprefix("protomark::") if ours else name.split()[0]
        shares[short] += float(share) / 100
    return sorted(((share, name) for name, share in shares.items()), reverse=True)


def main() -> None:
    """Prints a table for each kind of work."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--landmarks", type=int, default=1_000_000)
    parser.add_argument("--work", default=",".join(WORK), help="default: all kinds")
    parser.add_argument("--seconds", type=float, default=5.0)
    args = parser.parse_args()
    real = RealLandmarks.load([])
    workload = Workload(real, pm.Encoder.load(real.descriptor), build_threads=2)
    for name in args.work.split(","):
        found = sampled(work(name, workload, args.landmarks), args.seconds)
        rows = [[symbol, f"{100 * share:.0f} %"] for share, symbol in found if share >= SHOWN]
        print(ReportTable((name, "share"), rows).markdown(), end="\n\n")


if __name__ == "__main__":
    main()
