"""The same landmarks' unaggregated descriptors, searched by Hamming distance."""

from __future__ import annotations

import protomark as pm
from protomark.bench.machine import lacks
from protomark.bench.peers import installed
from protomark.bench.progress import Bar
from protomark.bench.race import Contender, race, turns
from protomark.bench.results import Contest, Results
from protomark.bench.workload import Workload


def run(workload: Workload, results: Results, bar: Bar) -> None:
    """Prototypes beside all descriptors in our search, OpenCV's and FAISS's; k = 2."""
    settings = workload.settings
    bar.begin("hamming", len(settings.exact) * (turns(4, settings.pace) + 1))
    each = workload.grown.observations * workload.encoder.bits // 8
    for n in settings.exact:
        bar.advance(f"{n:,} landmarks")
        reason = lacks(3.0 * n * each)
        if reason:
            results.skipped.append(f"hamming, {n:,} landmarks: {reason}")
            continue
        results.contests.append(
            Contest(
                "hamming",
                f"exact, {n:,} landmarks with {workload.grown.observations} descriptors each",
                "query",
                settings.threads,
                n,
                # Of prototypes, the fastest of ours.
                work={"multiply_adds": float(n * settings.dim)},
                timings=race(
                    _contenders(workload, n), settings.queries, settings.pace, bar.advance
                ),
            )
        )


def _contenders(workload: Workload, n: int) -> list[Contender]:
    threads = workload.settings.threads
    queries = workload.queries(n, workload.settings.queries)
    codes = workload.codes(queries)
    rows = workload.grown.descriptors(n)
    scene = workload.map(n)
    entrants = [
        Contender(
            "Protomark, prototypes",
            lambda q: scene.search_codes(codes[:q], k=2, threads=threads),
            ours=True,
            least=64,
        ),
        Contender(
            "Protomark, Hamming",
            lambda q: pm.hamming_search(queries[:q], rows, k=2, threads=threads),
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
    for entrant in entrants:
        entrant.facts["bytes"] = rows.nbytes / n
    entrants[0].facts["bytes"] = workload.settings.dim + 1
    return entrants
