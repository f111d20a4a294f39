"""Which functions of the core the time of encoding, adding and searching goes to.

python benchmarks/hot_spots.py [--landmarks 1000000] [--work encode,add,...]

Linux `perf` samples one thread, a thousand times a second, while one kind of work is done again and
again on landmarks that are grown from the bundled sample as `protomark bench` does. Functions have
names where the package was installed with them:

    pip install . -C cmake.build-type=RelWithDebInfo \
      -C cmake.define.CMAKE_CXX_FLAGS_RELWITHDEBINFO="-O3 -g -DNDEBUG"

What the compiler made part of another function counts as that one's.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np

import protomark as pm
from protomark.bench.grown import map_of
from protomark.bench.real import Observations
from protomark.bench.settings import Settings
from protomark.bench.workload import Workload

SHOWN = 0.02  # least share of a function that is printed
WORK = ("encode", "add", "exact", "one query", "approximate")


def work(name: str, landmarks: int) -> Callable[[], object]:
    """Something to do again and again."""
    real = Observations.load([])
    workload = Workload(real, pm.Encoder.load(real.descriptor), Settings())
    encoder, dim = workload.encoder, workload.settings.dim
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


def repeat(name: str, landmarks: int, seconds: float, ready: Path) -> None:
    """Do it for so long; `ready` comes into being when it is about to begin."""
    run = work(name, landmarks)
    run()
    ready.touch()
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        run()


def sampled(name: str, landmarks: int, seconds: float) -> list[tuple[float, str]]:
    """Share and name of each function, the greatest first."""
    with tempfile.TemporaryDirectory() as folder:
        ready, data = Path(folder) / "ready", Path(folder) / "perf.data"
        options = ["--repeat", name, "--landmarks", str(landmarks), "--ready", str(ready)]
        child = subprocess.Popen(
            [sys.executable, __file__, *options, "--seconds", str(seconds + 5)]
        )
        try:
            while not ready.exists():
                if child.poll() is not None:
                    raise SystemExit(f"{name}: ended early")
                time.sleep(0.1)
            record = ["perf", "record", "-q", "-e", "cpu-clock", "-F", "1000", "-p", str(child.pid)]
            subprocess.run([*record, "-o", data, "--", "sleep", str(seconds)], check=True)
        finally:
            child.kill()
            child.wait()
        report = ["perf", "report", "-q", "--stdio", "--sort", "symbol", "-i", str(data)]
        text = subprocess.run(report, check=True, capture_output=True, text=True).stdout
    rows = re.findall(r"^\s*([\d.]+)%\s+\[.\] (.+)$", text, re.MULTILINE)
    shares: dict[str, float] = defaultdict(float)
    for share, symbol in rows:
        shares[short(symbol)] += float(share) / 100
    return sorted(((share, name) for name, share in shares.items()), reverse=True)


def short(symbol: str) -> str:
    """A function's name without what it is a template of."""
    name = symbol.replace("(anonymous namespace)::", "")
    ours = re.search(r"protomark::[\w:]+", name)
    return ours.group().removeprefix("protomark::") if ours else name.split()[0]


def main() -> int:
    """Print a table for each kind of work."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--landmarks", type=int, default=1_000_000)
    parser.add_argument("--work", default=",".join(WORK))
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--repeat", choices=WORK, help=argparse.SUPPRESS)
    parser.add_argument("--ready", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.repeat:
        repeat(arguments.repeat, arguments.landmarks, arguments.seconds, arguments.ready)
        return 0
    for name in arguments.work.split(","):
        print(f"\n{name}")
        for share, symbol in sampled(name, arguments.landmarks, arguments.seconds):
            if share >= SHOWN:
                print(f"  {100 * share:3.0f} %  {symbol}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
