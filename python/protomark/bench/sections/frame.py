"""A whole frame: its descriptors encoded, searched and ratio-tested."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protomark import PrototypeMap
from protomark.bench.grown import map_of
from protomark.bench.progress import Bar
from protomark.bench.race import Contender, race, turns
from protomark.bench.results import Contest, Results
from protomark.bench.workload import Workload

THREADS = (1, 2)
DESCRIPTORS, RATIO, RECALL = 1_000, 0.8, 0.98


def run(workload: Workload, results: Results, bar: Bar) -> None:
    """1,000 descriptors, exactly and approximately."""
    settings = workload.settings
    bar.begin("frame", len(THREADS) * turns(2, settings.pace) + 2)
    bar.advance("map")
    scene = workload.map(settings.map)
    bar.advance("index")
    indexed = map_of(workload.encoder, workload.prototypes(settings.map))
    indexed.build_index(threads=settings.build_threads)
    queries = workload.queries(settings.map, DESCRIPTORS)
    for threads in THREADS:
        entrants = [
            _contender("Protomark, exact", scene, queries, threads),
            _contender(f"Protomark, recall {RECALL}", indexed, queries, threads, RECALL),
        ]
        results.contests.append(
            Contest(
                "frame",
                f"{DESCRIPTORS:,} descriptors encoded, searched among {settings.map:,} landmarks, "
                "ratio-tested",
                "frame",
                threads,
                settings.map,
                timings=race(entrants, 1, settings.pace, bar.advance),
            )
        )


def _contender(
    name: str,
    scene: PrototypeMap,
    queries: NDArray[np.uint8],
    threads: int,
    recall: float | None = None,
) -> Contender:
    def search(_: int) -> None:
        scene.search(queries, k=2, ratio=RATIO, threads=threads, recall=recall)

    return Contender(name, search, ours=True)
