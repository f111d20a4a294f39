"""A whole frame: its descriptors encoded, searched and ratio-tested."""

from __future__ import annotations

from protomark.bench.progress import Bar
from protomark.bench.race import Contender, race, turns
from protomark.bench.results import Contest, Results
from protomark.bench.workload import Workload

THREADS = (1, 2)
DESCRIPTORS, RATIO = 1_000, 0.8


def run(workload: Workload, results: Results, bar: Bar) -> None:
    """1,000 descriptors, exactly and, where the map has an index, approximately."""
    settings = workload.settings
    bar.begin("frame", len(THREADS) * turns(2, settings.pace) + 1)
    bar.advance("map")
    scene = workload.map(settings.map)
    queries = workload.queries(settings.map, DESCRIPTORS)
    for threads in THREADS:
        entrants = [
            Contender(
                "Protomark, exact",
                lambda n, threads=threads: scene.search(  # type: ignore[misc]
                    queries, k=2, ratio=RATIO, threads=threads
                ),
                ours=True,
            )
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
