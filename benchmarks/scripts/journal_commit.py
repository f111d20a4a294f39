"""Measures the bytes and time of a commit, and the time that a journal adds to `add`.

python benchmarks/scripts/journal_commit.py [--landmarks 1000000] [--observations 1000]

The script adds observations of random landmarks, a tenth of them new, to a map with positions and
commits, --rounds times. After each commit it writes as many bytes to another file and syncs it: a
lower bound for this disk. It then times `add` and `add_codes`, where a journal costs most, in turn
on this map and on one without a journal.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

import protomark as pm
from protomark_bench.report import ReportTable


def milliseconds(work: Callable[[], object]) -> float:
    """How long `work` takes."""
    begin = time.perf_counter()
    work()
    return 1e3 * (time.perf_counter() - begin)


def random_map(landmarks: int, dim: int, rng: np.random.Generator) -> pm.PrototypeMap:
    """A map of landmarks 0, 1, ... with positions."""
    scene = pm.PrototypeMap(pm.Encoder.load("freak"), dim=dim)
    for begin in range(0, landmarks, 1 << 18):
        ids = np.arange(begin, min(landmarks, begin + (1 << 18)))
        scene.add_codes(ids, rng.integers(-127, 128, (len(ids), dim), dtype=np.int8))
        scene.set_positions(ids, rng.normal(0, 100, (len(ids), 3)))
    return scene


def append_and_sync(path: Path, data: bytes) -> None:
    """Appends bytes to a file and syncs it, the lower bound for a commit."""
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    try:
        os.write(handle, data)
        os.fsync(handle)
    finally:
        os.close(handle)


def measure(args: argparse.Namespace, folder: Path) -> dict[str, list[float]]:
    """Name -> measured values; the files are in `folder`."""
    rng = np.random.default_rng(0)
    path = folder / "scene.pmk"
    n, count, dim = args.landmarks, args.observations, args.dim
    found: dict[str, list[float]] = {}

    def note(name: str, value: float) -> None:
        found.setdefault(name, []).append(value)

    plain = random_map(n, dim, rng)
    note("save, ms", milliseconds(lambda: plain.save(path)))
    note("map file, bytes", path.stat().st_size)
    scene = pm.open(path, journal=True)
    assert isinstance(scene, pm.PrototypeMap)
    width = scene.encoder.bits // 8
    for _ in range(args.rounds):
        ids = rng.integers(0, n, count)
        ids[::10] += n  # a tenth of the landmarks are new
        scene.add(ids, rng.integers(0, 256, (count, width), dtype=np.uint8))
        begin = time.perf_counter()
        size = scene.commit()
        note("commit, ms", 1e3 * (time.perf_counter() - begin))
        note("commit, bytes", size)
        data = rng.bytes(size)
        note(
            "write and sync as many bytes, ms",
            milliseconds(partial(append_and_sync, folder / "beside", data)),
        )
    note(f"open after {args.rounds} commits, ms", milliseconds(lambda: pm.open(path)))
    for i in range(args.rounds):
        ids = rng.integers(0, n, count)
        descriptors = rng.integers(0, 256, (count, width), dtype=np.uint8)
        codes = rng.integers(-127, 128, (count, dim), dtype=np.int8)
        maps = [("with journal", scene), ("without", plain)]
        for name, one in maps if i % 2 else maps[::-1]:
            note(f"add {name}, ms", milliseconds(partial(one.add, ids, descriptors)))
            note(f"add_codes {name}, ms", milliseconds(partial(one.add_codes, ids, codes)))
        scene.commit()
    return found


def main() -> None:
    """Prints the median and the 10 % and 90 % quantiles."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--landmarks", type=int, default=1_000_000)
    parser.add_argument("--observations", type=int, default=1_000)
    parser.add_argument("--dim", type=int, default=32)
    parser.add_argument("--rounds", type=int, default=100)
    parser.add_argument(
        "--folder",
        type=Path,
        help="folder on the disk to measure; default: the system's temporary folder",
    )
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="protomark_journal_", dir=args.folder) as name:
        found = measure(args, Path(name))
    rows = [
        [name, *(f"{value:,.6g}" for value in np.percentile(values, [50, 10, 90]))]
        for name, values in found.items()
    ]
    print(ReportTable(("what", "median", "10 %", "90 %"), rows).markdown())


if __name__ == "__main__":
    main()
