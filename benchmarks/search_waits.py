"""How long searches wait for whoever changes or reads the map at the same time.

python benchmarks/search_waits.py --json FILE [--landmarks 1000000] [--searchers 1] [--seconds 3]

Threads of one process: some search all the time, one query a call; another one does one thing after
the other, each again and again for some seconds. What a search took beyond the median of
searches of the idle map is its *wait*, whatever it waited for: a lock, the interpreter (GIL), or a
core. Only searches that ran while the other thread was inside a call count. The map is random:
prototypes of two codes each. Twice: searched exactly, and by an index, with --probes cells.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.files import write_text

BATCHES = (1_000, 10_000, 100_000)


@dataclass
class Searcher:
    """Searches from now on until it is stopped, and keeps when each search began and ended."""

    scene: pm.PrototypeMap
    queries: NDArray[np.int8]
    probes: int | None
    times: list[tuple[float, float]] = field(default_factory=list)
    stopped: bool = False

    def run(self) -> None:
        """Search until stopped."""
        i = 0
        while not self.stopped:
            query = self.queries[i % len(self.queries)][None]
            begin = time.perf_counter()
            self.scene.search_codes(query, k=2, probes=self.probes)
            self.times.append((begin, time.perf_counter()))
            i += 1


def searches_while(
    searchers: list[Searcher], todo: Callable[[], object], seconds: float
) -> tuple[NDArray[np.float64], list[float]]:
    """Seconds that searches took while `todo` ran, and seconds that each of its runs took."""
    for searcher in searchers:
        searcher.times, searcher.stopped = [], False
    threads = [threading.Thread(target=searcher.run) for searcher in searchers]
    for thread in threads:
        thread.start()
    spans: list[tuple[float, float]] = []
    end = time.perf_counter() + seconds
    while not spans or time.perf_counter() < end:
        begin = time.perf_counter()
        todo()
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


def random_map(landmarks: int, dim: int, rng: np.random.Generator) -> pm.PrototypeMap:
    """Two observations of each landmark."""
    scene = pm.PrototypeMap(pm.Encoder.load("freak"), dim)
    for begin in range(0, landmarks, 1 << 18):
        ids = np.arange(begin, min(landmarks, begin + (1 << 18)))
        for _ in range(2):
            scene.add_codes(ids, random_codes(len(ids), dim, rng))
    return scene


def random_codes(n: int, dim: int, rng: np.random.Generator) -> NDArray[np.int8]:
    """Codes, (n, dim), spread as those of encoders are."""
    return np.clip(rng.normal(0, 40, (n, dim)), -127, 127).astype(np.int8)


def things_to_do(
    scene: pm.PrototypeMap, folder: Path, rng: np.random.Generator, indexed: bool
) -> dict[str, Callable[[], object]]:
    """What the other thread does, by name; the map stays about as large."""
    encoder, dim = scene.encoder, scene.dim
    landmarks = len(scene)
    largest = BATCHES[-1]
    descriptors = rng.integers(0, 256, (largest, encoder.bits // 8), dtype=np.uint8)
    known = rng.integers(0, landmarks, largest)
    other = pm.PrototypeMap(encoder, dim)
    other.add_codes(known, random_codes(largest, dim, rng))
    codes = random_codes(largest, dim, rng)
    new = np.arange(landmarks, landmarks + largest)

    def come_and_go() -> None:
        scene.add_codes(new, codes)
        scene.discard(new)

    def take_back() -> None:
        scene.add_codes(known, codes)
        scene.remove_codes(known, codes)

    def merge() -> None:
        scene.add_codes(new, codes)
        scene.merge(new[: largest // 2], new[largest // 2 :])
        scene.discard(new[: largest // 2])

    def measure_probes() -> None:
        # A tenth of the map changes, so that ranks are measured anew.
        scene.add_codes(np.arange(landmarks // 8), random_codes(landmarks // 8, dim, rng))
        scene.probes(0.95)

    def rearrange() -> None:
        # Other cells than before: else no row changes its place.
        scene.build_index(scene.index_cells - 1, in_place=True)

    return {
        "nothing": lambda: time.sleep(0.1),
        **{f"add {n:,}": partial(scene.add, known[:n], descriptors[:n]) for n in BATCHES},
        f"add and discard {largest:,} new landmarks": come_and_go,
        f"add and remove {largest:,} codes": take_back,
        f"add, merge and discard {largest:,}": merge,
        f"update with {len(other):,} landmarks": lambda: scene.update(other),
        "save": lambda: scene.save(folder / "scene.pmk"),
        "seal": lambda: scene.seal(folder / "scene.sealed.pmk"),
        "ids": lambda: scene.ids,
        **(
            {
                "add an eighth and measure probes": measure_probes,
                "build_index": scene.build_index,
                "build_index in place": rearrange,
            }
            if indexed
            else {}
        ),
    }


def summary(waits: NDArray[np.float64]) -> dict[str, float]:
    """Quantiles in milliseconds."""
    p50, p99, most = np.quantile(np.maximum(waits, 0), [0.5, 0.99, 1]) * 1e3
    return {"searches": len(waits), "p50_ms": p50, "p99_ms": p99, "max_ms": most}


def measure(
    scene: pm.PrototypeMap, searchers: int, seconds: float, probes: int | None
) -> list[dict[str, Any]]:
    """A row for each thing that the other thread does."""
    rng = np.random.default_rng(1)
    queries = random_codes(4096, scene.dim, rng)
    group = [Searcher(scene, queries, probes) for _ in range(searchers)]
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        usual = 0.0
        for name, todo in things_to_do(scene, Path(folder), rng, probes is not None).items():
            took, runs = searches_while(group, todo, seconds)
            if not rows:
                usual = float(np.median(took))
            row = {
                "other thread": name,
                "runs": len(runs),
                "run_ms": float(np.median(runs)) * 1e3,
                **summary(took - usual),
            }
            rows.append(row)
            print(
                f"  {name:<42} {row['run_ms']:9.1f} ms, {row['searches']:7,} searches waited "
                f"p50 {row['p50_ms']:.2f}, p99 {row['p99_ms']:.2f}, max {row['max_ms']:.2f} ms"
            )
        rows[0]["search_ms"] = usual * 1e3
    return rows


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--landmarks", type=int, default=1_000_000)
    parser.add_argument("--dim", type=int, default=32)
    parser.add_argument("--searchers", type=int, default=1, help="threads that search")
    parser.add_argument("--seconds", type=float, default=3, help="of each thing")
    parser.add_argument("--probes", type=int, default=8, help="cells that are searched")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    facts: dict[str, Any] = {
        "landmarks": asked.landmarks,
        "dim": asked.dim,
        "searchers": asked.searchers,
        "instruction_set": pm.instruction_set(),
    }
    scene = random_map(asked.landmarks, asked.dim, np.random.default_rng(0))
    print(f"{asked.landmarks:,} landmarks, {asked.dim} dimensions, searched exactly")
    facts["exact"] = measure(scene, asked.searchers, asked.seconds, None)
    scene.build_index()
    print(f"by {asked.probes} of {scene.index_cells:,} cells")
    facts["index"] = measure(scene, asked.searchers, asked.seconds, asked.probes)
    if asked.json:
        write_text(asked.json, json.dumps(facts, indent=1) + "\n")


if __name__ == "__main__":
    main()
