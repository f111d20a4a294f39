"""The largest map: sealed with its index, opened and searched."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import protomark as pm
from protomark.bench.grown import Grown
from protomark.bench.machine import lacks
from protomark.bench.progress import Bar
from protomark.bench.results import Results
from protomark.bench.workload import Workload

RECALL = 0.95
THREADS = 2
CODE_BITS = (8, 4)
# About, of a landmark: an open map while it is built and sealed; files of both kinds together.
OPEN_BYTES, FILE_BYTES = 170, 70
OBSERVATIONS = 2  # of a landmark here, so that making them takes minutes, not hours
_PART = 1 << 20


def run(workload: Workload, results: Results, bar: Bar) -> None:
    """File size, opening, 1,000 queries at a stated recall, with 8 and with 4 bits a number."""
    settings = workload.settings
    n = settings.large
    if n == 0:
        return
    reason = lacks(n * OPEN_BYTES, n * FILE_BYTES, settings.scratch)
    if reason:
        results.skipped.append(f"large, {n:,} landmarks: {reason}")
        return
    bar.begin("large", -(-n // _PART) + 1 + len(CODE_BITS))
    grown = Grown(
        workload.real,
        workload.encoder,
        settings.dim,
        observations=OBSERVATIONS,
        threads=settings.build_threads,
    )
    workload.forget()
    scene: Any = pm.PrototypeMap(workload.encoder, dim=settings.dim)
    began = time.perf_counter()
    for begin in range(0, n, _PART):
        bar.advance(f"{begin:,} of {n:,} landmarks")
        rows = grown.prototypes(min(_PART, n - begin), first=begin)
        scene.add_codes(np.arange(begin, begin + len(rows)), rows)
    figures = {"landmarks": float(n), "grow seconds": time.perf_counter() - began}
    bar.advance("index")
    indexed = hasattr(scene, "build_index")
    if indexed:
        began = time.perf_counter()
        scene.build_index(threads=settings.build_threads)
        figures["index seconds"] = time.perf_counter() - began
    landmarks = np.random.default_rng(7).integers(0, n, settings.queries)
    codes = workload.codes(grown.queries(landmarks))
    exact = scene.search_codes(codes, k=1, threads=THREADS)[1][:, 0]
    with tempfile.TemporaryDirectory(dir=settings.scratch) as folder:
        paths = {bits: Path(folder) / f"{bits}.pmk" for bits in CODE_BITS}
        for bits, path in paths.items():
            bar.advance(f"sealing, {bits} bits")
            scene.seal(path, bits=bits)
        del scene
        for bits, path in paths.items():
            _measure(figures, path, f"{bits} bits: ", codes, exact, indexed)
    results.large = figures


def _measure(
    figures: dict[str, float],
    path: Path,
    label: str,
    codes: Any,
    exact: Any,
    indexed: bool,
) -> None:
    figures[label + "file bytes"] = float(path.stat().st_size)
    began = time.perf_counter()
    scene: Any = pm.open(path)
    figures[label + "open seconds"] = time.perf_counter() - began
    how = {"recall": RECALL} if indexed else {}
    seconds = []
    for _ in range(3):
        began = time.perf_counter()
        found = scene.search_codes(codes, k=2, threads=THREADS, **how)[1][:, 0]
        seconds.append(time.perf_counter() - began)
    figures[label + "first query seconds"] = seconds[0]
    figures[label + "query seconds"] = min(seconds) * 1_000 / len(codes)
    if label.startswith("8"):  # 4 bits have distances of their own
        figures[label + "recall"] = float((found <= exact).mean())
