"""The largest map: sealed with its index, opened and searched."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.bench.grown import Grown
from protomark.bench.machine import lacks
from protomark.bench.peers.index import K
from protomark.bench.progress import Bar
from protomark.bench.results import Results
from protomark.bench.sections import growth
from protomark.bench.settings import Settings
from protomark.bench.workload import Workload

RECALL = 0.95
THREADS = 2
CODE_BITS = (8, 4)
# About, of a landmark: an open map while it is built and sealed; files of both kinds together.
OPEN_BYTES, FILE_BYTES = 140, 70
OBSERVATIONS = 2  # of a landmark here, so that making them takes minutes, not hours
_PART = 1 << 20
_FINER = f"recall of the nearest of 8 bits, asked for {growth.RECALL}"


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
    bar.begin("large", -(-n // _PART) + 3 + 2 * len(CODE_BITS))
    grown = Grown(
        workload.real,
        workload.encoder,
        settings.dim,
        observations=OBSERVATIONS,
        threads=settings.build_threads,
    )
    workload.forget()
    scene = pm.PrototypeMap(workload.encoder, dim=settings.dim)
    began = time.perf_counter()
    for begin in range(0, n, _PART):
        bar.advance(f"{begin:,} of {n:,} landmarks")
        rows = grown.prototypes(min(_PART, n - begin), first=begin)
        scene.add_codes(np.arange(begin, begin + len(rows)), rows)
    figures = {"landmarks": float(n), "grow seconds": time.perf_counter() - began}
    bar.advance("index")
    began = time.perf_counter()
    scene.build_index(threads=settings.build_threads, in_place=True)
    figures["index seconds"] = time.perf_counter() - began
    landmarks = np.random.default_rng(7).integers(0, n, settings.queries)
    codes = workload.codes(grown.queries(landmarks))
    with tempfile.TemporaryDirectory(dir=settings.scratch) as folder:
        paths = {bits: Path(folder) / f"{bits}.pmk" for bits in CODE_BITS}
        for bits, path in paths.items():
            bar.advance(f"sealing, {bits} bits")
            scene.seal(path, bits=bits)
        del scene
        bar.advance("searching exactly")
        nearest = pm.open(paths[8]).search_codes(codes, k=1, threads=THREADS)[0][:, 0]
        figures["the nearest prototype is of the landmark asked for"] = _share(nearest, landmarks)
        for bits, path in paths.items():
            bar.advance(f"searching, {bits} bits")
            measured = _measured(path, codes, nearest, landmarks)
            figures |= {f"{bits} bits: {name}": value for name, value in measured.items()}
        bar.advance("searching as smaller maps are")
        known = {(point["landmarks"], point["method"]) for point in results.growth}
        for point in _points(paths[8], codes, settings, figures[f"8 bits: {_FINER}"]):
            if (point["landmarks"], point["method"]) not in known:
                results.growth.append(point)
    results.large = figures


def _measured(
    path: Path,
    codes: NDArray[np.int8],
    nearest: NDArray[np.int64],
    landmarks: NDArray[np.int64],
) -> dict[str, float]:
    """Of one sealed map.

    Args:
        path: its file.
        codes: (q, dim) queries.
        nearest: (q,) what an exact search finds among prototypes of 8 bits.
        landmarks: (q,) what the queries are observations of.
    """
    began = time.perf_counter()
    scene = pm.open(path)
    opened = time.perf_counter() - began
    seconds = []
    for _ in range(5):
        began = time.perf_counter()
        found = scene.search_codes(codes, k=K, threads=THREADS, recall=RECALL)[0][:, 0]
        seconds.append(time.perf_counter() - began)
    exact = scene.search_codes(codes, k=K, threads=THREADS)[0][:, 0]
    finer = scene.search_codes(codes, k=K, threads=THREADS, recall=growth.RECALL)[0][:, 0]
    per = 1_000 / len(codes)
    return {
        "file bytes": float(path.stat().st_size),
        "open seconds": opened,
        "first 1,000 queries, seconds": per * seconds[0],
        "1,000 queries, seconds": per * median(seconds),
        "recall of this file's nearest": _share(found, exact),
        "recall of the nearest of 8 bits": _share(found, nearest),
        _FINER: _share(finer, nearest),
        "landmark asked for": _share(found, landmarks),
    }


def _points(
    path: Path, codes: NDArray[np.int8], settings: Settings, recall: float
) -> list[dict[str, Any]]:
    """The curves' last points, searched as the open maps of `growth` are."""
    scene = pm.open(path)
    return [
        {
            "landmarks": len(scene),
            "method": method,
            "seconds": growth.seconds_of_query(scene, codes, settings, recall=asked),
            "bytes": None,
            "file": path.stat().st_size / len(scene),
            "recall": reached,
            "threads": settings.threads,
        }
        for method, asked, reached in (
            ("exact", None, 1.0),
            ("approximate", growth.RECALL, recall),
        )
    ]


def _share(found: NDArray[np.int64], expected: NDArray[np.int64]) -> float:
    return float((found == expected).mean())
