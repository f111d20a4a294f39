"""The same landmarks' unaggregated descriptors, searched by Hamming distance."""

from __future__ import annotations

import protomark as pm
from protomark.bench.peers import installed
from protomark.bench.progress import Bar
from protomark.bench.race import Contender, race, turns
from protomark.bench.results import Contest, Results
from protomark.bench.workload import Workload


def run(workload: Workload, results: Results, bar: Bar) -> None:
    """Prototypes beside all descriptors in our search, OpenCV's and FAISS's; k = 2."""
    settings = workload.settings
    bar.begin("hamming", len(settings.exact) * (turns(4, settings.pace) + 1))
    for n in settings.exact:
        bar.advance(f"{n:,} landmarks")
        queries = workload.queries(n, settings.queries)
        codes = workload.codes(queries)
        rows = workload.grown.descriptors(n)
        scene = workload.map(n)
        entrants = [
            Contender(
                "Protomark, prototypes",
                lambda q, scene=scene, codes=codes: scene.search_codes(  # type: ignore[misc]
                    codes[:q], k=2, threads=settings.threads
                ),
                ours=True,
                least=64,
                facts={"bytes": settings.dim + 1},
            ),
            Contender(
                "Protomark, Hamming",
                lambda q, rows=rows, queries=queries: pm.hamming_search(  # type: ignore[misc]
                    queries[:q], rows, k=2, threads=settings.threads
                ),
                ours=True,
                least=64,
            ),
        ]
        if installed("cv2"):
            from protomark.bench.peers import opencv_matchers

            brute = opencv_matchers.brute_force(rows, queries)
            entrants.append(Contender("OpenCV BFMatcher", brute, least=16))
        if installed("faiss"):
            from protomark.bench.peers import faiss_indexes

            flat = faiss_indexes.binary_flat(rows, queries)
            entrants.append(Contender("FAISS IndexBinaryFlat", flat, least=64))
        each = rows.nbytes / n
        for entrant in entrants[1:]:
            entrant.facts["bytes"] = each
        results.contests.append(
            Contest(
                "hamming",
                f"exact, {n:,} landmarks with {workload.grown.observations} descriptors each",
                "query",
                settings.threads,
                n,
                work={"multiply_adds": float(n * settings.dim)},
                timings=race(entrants, settings.queries, settings.pace, bar.advance),
            )
        )
