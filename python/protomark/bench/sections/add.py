"""Adding observations to a large map, beside encoding alone."""

from __future__ import annotations

import numpy as np

from protomark.bench.grown import map_of
from protomark.bench.progress import Bar
from protomark.bench.race import Contender, race, turns
from protomark.bench.results import Contest, Results
from protomark.bench.workload import Workload


def run(workload: Workload, results: Results, bar: Bar) -> None:
    """Descriptors of landmarks drawn at random, all in the map already."""
    settings = workload.settings
    bar.begin("add", turns(2, settings.pace) + 1)
    bar.advance("map")
    n, count = settings.map, settings.encoded
    scene = map_of(workload.encoder, workload.prototypes(n))
    rng = np.random.default_rng(0)
    ids = rng.integers(0, n, count)
    descriptors = workload.queries(n, count)
    results.contests.append(
        Contest(
            "add",
            f"observations of random landmarks, {n:,} in the map, {count:,} at a time",
            "observation",
            settings.threads,
            n,
            timings=race(
                [
                    Contender(
                        "Protomark, add",
                        lambda q: scene.add(ids[:q], descriptors[:q], threads=settings.threads),
                        ours=True,
                        least=1_000,
                    ),
                    Contender(
                        "Protomark, encode alone",
                        lambda q: workload.encoder.encode(
                            descriptors[:q], dim=settings.dim, threads=settings.threads
                        ),
                        least=1_000,
                    ),
                ],
                count,
                settings.pace,
                bar.advance,
            ),
        )
    )
