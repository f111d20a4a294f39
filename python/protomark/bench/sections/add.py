"""Adding observations to a large map, beside encoding alone."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from protomark import PrototypeMap
from protomark.bench.grown import map_of
from protomark.bench.progress import Bar
from protomark.bench.race import Contender, race, turns
from protomark.bench.results import Contest, Results
from protomark.bench.workload import Workload

THREADS = (1, 2)


def run(workload: Workload, results: Results, bar: Bar) -> None:
    """Descriptors of landmarks drawn at random, all in the map already."""
    settings = workload.settings
    bar.begin("add", len(THREADS) * turns(2, settings.pace) + 1)
    bar.advance("map")
    n, count = settings.map, settings.encoded
    scene = map_of(workload.encoder, workload.prototypes(n))
    rng = np.random.default_rng(0)
    ids = rng.integers(0, n, count)
    descriptors = workload.queries(n, count)
    for threads in THREADS:
        entrants = [
            Contender(
                "Protomark, add",
                partial(_add, scene, ids, descriptors, threads),
                ours=True,
                least=1_000,
            ),
            Contender(
                "Protomark, encode alone",
                partial(_encode, workload, descriptors, threads),
                least=1_000,
            ),
        ]
        results.contests.append(
            Contest(
                "add",
                f"observations of random landmarks, {n:,} in the map, {count:,} at a time",
                "observation",
                threads,
                n,
                timings=race(entrants, count, settings.pace, bar.advance),
            )
        )


def _add(
    scene: PrototypeMap,
    ids: NDArray[np.int64],
    descriptors: NDArray[np.uint8],
    threads: int,
    count: int,
) -> None:
    scene.add(ids[:count], descriptors[:count], threads=threads)


def _encode(workload: Workload, descriptors: NDArray[np.uint8], threads: int, count: int) -> None:
    dim = workload.settings.dim
    workload.encoder.encode(descriptors[:count], dim=dim, threads=threads)
