"""Exact search of prototypes."""

from __future__ import annotations

from dataclasses import replace

from protomark.bench.machine import last_level_cache
from protomark.bench.peers import installed
from protomark.bench.progress import Bar
from protomark.bench.race import Contender, race, turns
from protomark.bench.results import Contest, Results
from protomark.bench.workload import Workload

CACHES = 4  # a map of so many times the last-level cache is read from memory, nearly all of it


def run(workload: Workload, results: Results, bar: Bar) -> None:
    """K = 2, beside FAISS IndexFlatL2 on the same prototypes as float32."""
    settings = workload.settings
    bar.begin("search", (len(settings.exact) + 1) * turns(2, settings.pace))
    for n in settings.exact:
        bar.advance(f"{n:,} landmarks")
        entrants = _contenders(workload, n)
        contest = Contest(
            "search",
            f"exact, {n:,} landmarks, {settings.dim}-d, k = 2",
            "query",
            settings.threads,
            n,
            work={"multiply_adds": float(n * settings.dim)},
            timings=race(entrants, settings.queries, settings.pace, bar.advance),
        )
        results.contests.append(contest)
    # Of the largest map: one query has to read all of it, from memory where no cache holds it.
    from_memory = n * settings.dim >= CACHES * last_level_cache()
    alone = replace(
        contest,
        title=f"{contest.title}, one query at a time",
        work={"bytes": float(n * settings.dim)} if from_memory else {},
        timings=race(entrants, 1, settings.pace, bar.advance),
    )
    results.contests.append(alone)


def _contenders(workload: Workload, n: int) -> list[Contender]:
    settings = workload.settings
    codes = workload.codes(workload.queries(n, settings.queries))
    scene = workload.map(n)
    entrants = [
        Contender(
            "Protomark",
            lambda q: scene.search_codes(codes[:q], k=2, threads=settings.threads),
            ours=True,
            least=64,
        )
    ]
    if installed("faiss"):
        from protomark.bench.peers import faiss_indexes

        flat = faiss_indexes.flat(workload.prototypes(n), codes)
        entrants.append(Contender("FAISS IndexFlatL2", flat, least=settings.queries))
    return entrants
