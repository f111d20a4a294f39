"""Times search among 1 % of a map of 1,000,000 landmarks beside the exact search of all of it.

python benchmarks/scripts/filtered_search.py
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

import protomark as pm

LANDMARKS, DIM, SHARE, ROUNDS = 1_000_000, 32, 0.01, 7


def milliseconds(call: Callable[[], object]) -> float:
    """The least time of several rounds: other programs only add to it."""
    times = []
    for _ in range(ROUNDS):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return 1000 * min(times)


def main() -> None:
    """Print a table in Markdown."""
    rng = np.random.default_rng(0)
    scene = pm.PrototypeMap(pm.Encoder.load("freak"), DIM)
    codes = np.clip(rng.normal(0, 30, (LANDMARKS, DIM)), -127, 127).astype(np.int8)
    scene.add_codes(np.arange(LANDMARKS), codes)
    count = int(SHARE * LANDMARKS)
    chosen = {
        "consecutive": np.arange(count),
        "scattered": np.sort(rng.choice(LANDMARKS, count, replace=False)),
    }
    print("| map | queries | all, ms | among | 1 %, ms | share of the time |")
    print("|---|---:|---:|---|---:|---:|")
    with tempfile.TemporaryDirectory() as folder:
        for name, searched in (
            ("learning", scene),
            ("sealed, 17 bytes", scene.seal(Path(folder) / "map.pmk", bytes_per_landmark=17)),
        ):
            for queries in (1000, 1):
                asked = np.ascontiguousarray(codes[rng.choice(LANDMARKS, queries)])
                whole = milliseconds(partial(searched.search_codes, asked))
                for where, ids in chosen.items():
                    part = milliseconds(partial(searched.search_codes, asked, among=ids))
                    print(
                        f"| {name} | {queries:,} | {whole:.2f} | {where} | {part:.2f} | "
                        f"1/{whole / part:.1f} |"
                    )


if __name__ == "__main__":
    main()
