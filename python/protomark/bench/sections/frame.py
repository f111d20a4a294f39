"""A whole frame: its descriptors encoded, searched and ratio-tested."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.bench.grown import map_of
from protomark.bench.progress import Bar
from protomark.bench.race import Contender, race, turns
from protomark.bench.results import Contest, Results
from protomark.bench.workload import Workload

THREADS = (1, 2)
DESCRIPTORS, RATIO, RECALL = 1_000, 0.8, 0.98


def run(workload: Workload, results: Results, bar: Bar) -> None:
    """1,000 descriptors, exactly and, where the map has an index, approximately."""
    settings = workload.settings
    bar.begin("frame", len(THREADS) * turns(2, settings.pace) + 2)
    bar.advance("map")
    scene: Any = workload.map(settings.map)
    indexed: Any = None
    if hasattr(scene, "build_index"):
        bar.advance("index")
        indexed = map_of(workload.encoder, workload.prototypes(settings.map))
        indexed.build_index(threads=settings.build_threads)
    queries = workload.queries(settings.map, DESCRIPTORS)
    for threads in THREADS:
        entrants = [_contender("Protomark, exact", scene, queries, threads)]
        if indexed is not None:
            name = f"Protomark, recall {RECALL}"
            entrants.append(_contender(name, indexed, queries, threads, recall=RECALL))
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
    name: str, scene: Any, queries: NDArray[np.uint8], threads: int, **how: float
) -> Contender:
    return Contender(
        name, lambda _: scene.search(queries, k=2, ratio=RATIO, threads=threads, **how), ours=True
    )
