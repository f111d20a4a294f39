"""Measures how long searches wait for a thread that changes or reads the map at the same time.

python benchmarks/scripts/search_waits.py [--landmarks 1000000] [--searchers 1] [--seconds 3]

Threads of one process search all the time, one query per call; another thread repeats each
operation for --seconds. The time that a search takes beyond the median search of the idle map is
its *wait*, whether it waits for a lock, the interpreter (GIL) or a core. Only searches that run
while the other thread is inside a call count. The map is random: each prototype is the mean of two
codes. The threads search exactly, then by an index with --nprobe inverted lists.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark_bench.report import ReportTable

BATCHES = (1_000, 10_000, 100_000)


@dataclass
class Searcher:
    """Searches until it is stopped, and records the start and end of each search."""

    scene: pm.PrototypeMap
    queries: NDArray[np.int8]
    nprobe: int | None
    times: list[tuple[float, float]] = field(default_factory=list)
    stopped: bool = False

    def run(self) -> None:
        """Searches until stopped."""
        i = 0
        while not self.stopped:
            query = self.queries[i % len(self.queries)][None]
            begin = time.perf_counter()
            self.scene.search_codes(query, k=2, nprobe=self.nprobe)
            self.times.append((begin, time.perf_counter()))
            i += 1


def searches_while(
    searchers: list[Searcher], work: Callable[[], object], seconds: float
) -> tuple[NDArray[np.float64], list[float]]:
    """Seconds of each search while `work` was repeated, and seconds of each of its runs."""
    for searcher in searchers:
        searcher.times, searcher.stopped = [], False
    threads = [threading.Thread(target=searcher.run) for searcher in searchers]
    for thread in threads:
        thread.start()
    spans: list[tuple[float, float]] = []
    end = time.perf_counter() + seconds
    while not spans or time.perf_counter() < end:
        begin = time.perf_counter()
        work()
        spans.append((begin, time.perf_counter()))
    for searcher in searchers:
        searcher.stopped = True
    for thread in threads:
        thread.join()
    times = np.array([t for searcher in searchers for t in searcher.times]).reshape(-1, 2)
    starts, ends = np.array(spans).T
    # The run that began last before a search ended.
    run = np.searchsorted(starts, times[:, 1]) - 1
    during = (run >= 0) & (times[:, 0] < ends[np.maximum(run, 0)])
    return np.diff(times[during], axis=1)[:, 0], (ends - starts).tolist()


def random_codes(n: int, dim: int, rng: np.random.Generator) -> NDArray[np.int8]:
    """Codes, (n, dim), with about the spread of an encoder's."""
    return np.clip(rng.normal(0, 40, (n, dim)), -127, 127).astype(np.int8)


def works(
    scene: pm.PrototypeMap, folder: Path, rng: np.random.Generator, indexed: bool
) -> dict[str, Callable[[], object]]:
    """Name -> operation of the other thread. All leave the map about as large as before."""
    encoder, dim, landmarks, largest = scene.encoder, scene.dim, len(scene), BATCHES[-1]
    descriptors = rng.integers(0, 256, (largest, encoder.bits // 8), dtype=np.uint8)
    existing = rng.integers(0, landmarks, largest)
    other = pm.PrototypeMap(encoder, dim)
    other.add_codes(existing, random_codes(largest, dim, rng))
    codes = random_codes(largest, dim, rng)
    new = np.arange(landmarks, landmarks + largest)

    def add_and_remove() -> None:
        scene.add_codes(new, codes)
        scene.remove(new)

    def add_and_subtract() -> None:
        scene.add_codes(existing, codes)
        scene.subtract_codes(existing, codes)

    def merge() -> None:
        scene.add_codes(new, codes)
        scene.merge_landmarks(new[: largest // 2], new[largest // 2 :])
        scene.remove(new[: largest // 2])

    def measure_recall() -> None:
        # The map measures its recall table again once this share of it has changed.
        scene.add_codes(np.arange(landmarks // 8), random_codes(landmarks // 8, dim, rng))
        scene.nprobe(0.95)

    found: dict[str, Callable[[], object]] = {
        "nothing": lambda: time.sleep(0.1),
        **{
            f"add, {n:,} observations": partial(scene.add, existing[:n], descriptors[:n])
            for n in BATCHES
        },
        f"add_codes and remove, {largest:,} new landmarks": add_and_remove,
        f"add_codes and subtract_codes, {largest:,}": add_and_subtract,
        f"add_codes, merge_landmarks and remove, {largest:,}": merge,
        f"merge_map with {len(other):,} landmarks": lambda: scene.merge_map(other),
        "save": lambda: scene.save(folder / "scene.pmk"),
        "seal": lambda: scene.seal(folder / "scene.sealed.pmk"),
        "ids": lambda: scene.ids,
    }
    if indexed:
        found["add_codes of an eighth of the map, nprobe"] = measure_recall
        found["build_index"] = scene.build_index
        # With the same nlist no row would move.
        rebuild = lambda: scene.build_index(scene.nlist - 1, in_place=True)  # noqa: E731
        found["build_index(in_place=True)"] = rebuild
    return found


def measure(
    scene: pm.PrototypeMap, searchers: int, seconds: float, nprobe: int | None
) -> ReportTable:
    """A row per operation of the other thread."""
    rng = np.random.default_rng(1)
    queries = random_codes(4096, scene.dim, rng)
    group = [Searcher(scene, queries, nprobe) for _ in range(searchers)]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        idle = 0.0
        for name, work in works(scene, Path(folder), rng, nprobe is not None).items():
            took, runs = searches_while(group, work, seconds)
            idle = idle or float(np.median(took))
            waits = 1e3 * np.quantile(np.maximum(took - idle, 0), [0.5, 0.99, 1])
            cells = [f"{1e3 * np.median(runs):.4g}", f"{len(took):,}"]
            rows.append([name, *cells, *(f"{wait:.2f}" for wait in waits)])
    heads = ("the other thread, again and again", "a run of it, ms", "searches")
    return ReportTable((*heads, "wait p50, ms", "p99", "max"), rows)


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--landmarks", type=int, default=1_000_000, help="default: 1000000")
    parser.add_argument("--dim", type=int, default=32, help="code length; default: 32")
    parser.add_argument("--searchers", type=int, default=1, help="threads that search; default: 1")
    parser.add_argument(
        "--seconds", type=float, default=3, help="seconds per operation; default: 3"
    )
    parser.add_argument(
        "--nprobe", type=int, default=8, help="inverted lists to search; default: 8"
    )
    args = parser.parse_args()
    rng = np.random.default_rng(0)
    scene = pm.PrototypeMap(pm.Encoder.load("freak"), args.dim)
    for begin in range(0, args.landmarks, 1 << 18):
        ids = np.arange(begin, min(args.landmarks, begin + (1 << 18)))
        for _ in range(2):
            scene.add_codes(ids, random_codes(len(ids), args.dim, rng))
    print(f"{args.landmarks:,} landmarks, {args.dim} dimensions, searched exactly\n")
    print(measure(scene, args.searchers, args.seconds, None).markdown())
    scene.build_index()
    print(f"\nby {args.nprobe} of {scene.nlist:,} inverted lists\n")
    print(measure(scene, args.searchers, args.seconds, args.nprobe).markdown())


if __name__ == "__main__":
    main()
