"""What a commit costs, in bytes and time, and what keeping a journal costs `add`.

python benchmarks/journal_commit.py [--landmarks 1000000] [--observations 1000] [--json FILE]

A map of so many landmarks with positions gets so many observations of landmarks drawn at random, a
tenth of them new ones, and commits, again and again. Beside each commit as many bytes are written
to another file and synced: that is what the disk takes, whoever writes. Then `add` is timed on this
map and on one without a journal, in turn, and `add_codes`, where a journal weighs most.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import protomark as pm
from protomark.console import console, progress_bar


def seconds(work: Callable[[], object]) -> float:
    """How long it takes."""
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def map_of(landmarks: int, dim: int, rng: np.random.Generator) -> pm.PrototypeMap:
    """A map of landmarks 0, 1, ... with positions."""
    scene = pm.PrototypeMap(pm.Encoder.load("freak"), dim=dim)
    for begin in range(0, landmarks, 1 << 18):
        ids = np.arange(begin, min(landmarks, begin + (1 << 18)))
        scene.add_codes(ids, rng.integers(-127, 128, (len(ids), dim), dtype=np.int8))
        scene.set_positions(ids, rng.normal(0, 100, (len(ids), 3)))
    return scene


def synced(path: Path, data: bytes) -> None:
    """Append and sync, the least that a commit can do."""
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    try:
        os.write(handle, data)
        os.fsync(handle)
    finally:
        os.close(handle)


def spread(values: list[float]) -> dict[str, float]:
    """Median and the tenths at both ends."""
    low, middle, high = np.percentile(values, [10, 50, 90])
    return {"median": float(middle), "p10": float(low), "p90": float(high)}


def measure(args: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """All figures, with the files in this folder."""
    rng = np.random.default_rng(0)
    path = folder / "scene.pmk"
    n, count = args.landmarks, args.observations
    commits, beside, sizes = [], [], []
    adds: dict[str, list[float]] = {}
    with progress_bar() as bar:
        task = bar.add_task("map", total=2 * args.rounds)
        plain = map_of(n, args.dim, rng)
        saving = seconds(lambda: plain.save(path))
        scene = pm.open(path, journal=True)
        assert isinstance(scene, pm.PrototypeMap)
        bits = scene.encoder.bits
        for _ in bar.track(range(args.rounds), task_id=task, description="commits"):
            ids = rng.integers(0, n, count)
            ids[::10] += n  # a tenth of them are new
            scene.add(ids, rng.integers(0, 256, (count, bits // 8), dtype=np.uint8))
            begin = time.perf_counter()
            sizes.append(scene.commit())
            commits.append(time.perf_counter() - begin)
            data = rng.bytes(sizes[-1])
            beside.append(seconds(partial(synced, folder / "beside", data)))
        journal = pm.file_journal(path)
        opening = seconds(lambda: pm.open(path))
        for i in bar.track(range(args.rounds), task_id=task, description="add"):
            ids = rng.integers(0, n, count)
            descriptors = rng.integers(0, 256, (count, bits // 8), dtype=np.uint8)
            codes = rng.integers(-127, 128, (count, args.dim), dtype=np.int8)
            maps = [("with journal", scene), ("without", plain)]
            for name, one in maps if i % 2 else maps[::-1]:
                adds.setdefault(f"add {name}", []).append(
                    seconds(partial(one.add, ids, descriptors))
                )
                adds.setdefault(f"add_codes {name}", []).append(
                    seconds(partial(one.add_codes, ids, codes))
                )
            scene.commit()
    return {
        "landmarks": n,
        "dim": args.dim,
        "observations": count,
        "rounds": args.rounds,
        "commit, bytes": spread([float(s) for s in sizes]),
        "commit, ms": spread([1e3 * t for t in commits]),
        "writing and syncing as many bytes, ms": spread([1e3 * t for t in beside]),
        "map file, bytes": path.stat().st_size,
        "save, ms": 1e3 * saving,
        **{
            f"{name}, ns an observation": spread([1e9 * t / count for t in times])
            for name, times in sorted(adds.items())
        },
        "journal": journal,
        "open with these commits, ms": 1e3 * opening,
        "compact, ms": 1e3 * seconds(scene.compact),
        "open compacted, ms": 1e3 * seconds(lambda: pm.open(path)),
        "instruction set": pm.instruction_set(),
        "version": pm.__version__,
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--landmarks", type=int, default=1_000_000)
    parser.add_argument("--observations", type=int, default=1_000)
    parser.add_argument("--dim", type=int, default=32)
    parser.add_argument("--rounds", type=int, default=100)
    parser.add_argument("--folder", type=Path, help="the disk to measure; default: the system's")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="protomark_journal_", dir=args.folder) as name:
        result = measure(args, Path(name))
    for key, value in result.items():
        console.print(f"{key}: {value}", highlight=False)
    if args.json:
        args.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
