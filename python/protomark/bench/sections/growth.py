"""Time and memory as a map grows."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark import PrototypeMap, SealedMap
from protomark.bench.grown import map_of
from protomark.bench.machine import allocated_bytes, lacks
from protomark.bench.peers.index import K
from protomark.bench.progress import Bar
from protomark.bench.race import Contender, race
from protomark.bench.results import Results
from protomark.bench.settings import Settings
from protomark.bench.workload import Workload

RECALL = 0.98
OPEN_BYTES = 200  # of a landmark of an open map with its index, at most, about


def run(workload: Workload, results: Results, bar: Bar) -> None:
    """Open maps of every size, searched exactly and approximately."""
    settings = workload.settings
    bar.begin("growth", 3 * len(settings.growth))
    for n in settings.growth:
        reason = lacks(n * OPEN_BYTES)
        if reason:
            results.skipped.append(f"growth, {n:,} landmarks: {reason}")
            continue
        bar.advance(f"{n:,} landmarks")
        codes = workload.codes(workload.queries(n, settings.queries))
        rows = workload.prototypes(n)
        before = allocated_bytes()
        scene = map_of(workload.encoder, rows)
        scene.search_codes(codes[:1], k=K)
        used = _since(before)

        bar.advance(f"{n:,} landmarks, exact")
        results.growth.append(
            _point(
                n,
                "exact",
                seconds_of_query(scene, codes, settings),
                used,
                recall=1.0,
                threads=settings.threads,
            )
        )
        bar.advance(f"{n:,} landmarks, approximate")
        exact = scene.search_codes(codes, k=1, threads=settings.build_threads)[1]
        began = time.perf_counter()
        scene.build_index(threads=settings.build_threads)
        built = time.perf_counter() - began
        found = scene.search_codes(codes, k=1, threads=settings.build_threads, recall=RECALL)[1]
        facts = {"recall": _recall(found, exact), "build": built}
        seconds = seconds_of_query(scene, codes, settings, recall=RECALL)
        used = _since(before)
        scene.drop_index()
        plain = _since(before)
        if used is not None and plain is not None:
            facts["index"] = (used - plain) / n
        results.growth.append(
            _point(n, "approximate", seconds, used, threads=settings.threads, **facts)
        )
        del scene, rows  # what is freed later would be missing from the next map's memory


def seconds_of_query(
    scene: PrototypeMap | SealedMap,
    codes: NDArray[np.int8],
    settings: Settings,
    recall: float | None = None,
) -> float:
    """Seconds of one of many queries, exactly or at a recall, on `settings.threads`."""

    def search(q: int) -> None:
        scene.search_codes(codes[:q], k=K, threads=settings.threads, recall=recall)

    entrant = Contender("search", search, least=64)
    return race([entrant], settings.queries, replace(settings.pace, rounds=3))[0].median


def _point(
    n: int, method: str, seconds: float, memory: int | None, **facts: float
) -> dict[str, Any]:
    """Memory is of the open map: what the process has allocated since, in bytes a landmark."""
    each = None if memory is None else memory / n
    return {"landmarks": n, "method": method, "seconds": seconds, "bytes": each, **facts}


def _since(before: int | None) -> int | None:
    now = allocated_bytes()
    return None if before is None or now is None else max(now - before, 0)


def _recall(found: NDArray[np.int32], exact: NDArray[np.int32]) -> float:
    return float((found[:, 0] <= exact[:, 0]).mean())
