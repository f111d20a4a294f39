"""The section large: the largest map is sealed with its index, opened and searched."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from statistics import median

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark_bench.machine import shortage
from protomark_bench.speed import sections
from protomark_bench.speed.landmarks import SyntheticLandmarks
from protomark_bench.speed.peers.index import K
from protomark_bench.speed.sections import Bench

RECALL, THREADS = 0.95, 2
# How prototypes are stored: as int8 numbers, and as words of two numbers.
FORMS = ("int8", "words")
# Bytes per landmark, about, of a learning map while it is built and sealed, and of both files.
_LEARNING_BYTES, _FILE_BYTES = 140, 70
_OBSERVATIONS = 2  # per landmark, so that generating them takes minutes, not hours
_PART = 1 << 20
_FINER = f"recall of the nearest of int8, asked for {sections.RECALL}"


def large(bench: Bench) -> None:
    """Measure file size, opening, and 1,000 queries at a recall, as int8 and as words."""
    workload, settings, n = bench.workload, bench.settings, bench.settings.large
    if n == 0:
        return
    reason = shortage(n * _LEARNING_BYTES, n * _FILE_BYTES)
    if reason:
        bench.results.skipped.append(f"large, {n:,} landmarks: {reason}")
        return
    synthetic = SyntheticLandmarks(
        workload.real,
        workload.encoder,
        workload.dim,
        observations=_OBSERVATIONS,
        threads=settings.build_threads,
    )
    workload.forget()
    scene = pm.PrototypeMap(workload.encoder, dim=workload.dim)
    begin = time.perf_counter()
    for first in range(0, n, _PART):
        bench.advance(f"{first:,} of {n:,} landmarks")
        rows = synthetic.prototypes(min(_PART, n - first), first)
        scene.add_codes(np.arange(first, first + len(rows)), rows)
    figures = {"landmarks": float(n), "growth seconds": time.perf_counter() - begin}
    bench.advance("index")
    begin = time.perf_counter()
    scene.build_index(threads=settings.build_threads, in_place=True)
    figures["index seconds"] = time.perf_counter() - begin
    landmarks = np.random.default_rng(7).integers(0, n, settings.queries)
    codes = workload.codes(synthetic.queries(landmarks))
    with tempfile.TemporaryDirectory(prefix="protomark-") as folder:
        paths = {form: Path(folder) / f"{form}.pmk" for form in FORMS}
        for form, path in paths.items():
            bench.advance(f"sealing, {form}")
            size = None if form == "int8" else workload.dim // 2 + 1
            scene.seal(path, bytes_per_landmark=size)
        del scene
        bench.advance("searching exactly")
        nearest = pm.open(paths["int8"]).search_codes(codes, k=1, threads=THREADS)[0][:, 0]
        name = "the nearest prototype is of the landmark asked for"
        figures[name] = _share(nearest, landmarks)
        for form, path in paths.items():
            bench.advance(f"searching, {form}")
            measured = _measured(path, codes, nearest, landmarks)
            figures |= {f"{form}: {name}": value for name, value in measured.items()}
        bench.advance("searching as smaller maps are")
        _extend_growth(bench, paths["int8"], codes, figures[f"int8: {_FINER}"])
    bench.results.large = figures


def _measured(
    path: Path,
    codes: NDArray[np.int8],
    nearest: NDArray[np.int64],
    landmarks: NDArray[np.int64],
) -> dict[str, float]:
    """Figures of one sealed map.

    Args:
        path: the file of the map.
        codes: (q, dim) queries.
        nearest: (q,) nearest landmarks of an exact search among int8 prototypes.
        landmarks: (q,) landmarks that the queries observe.
    """
    begin = time.perf_counter()
    scene = pm.open(path)
    opened = time.perf_counter() - begin
    seconds = []
    for _ in range(5):
        begin = time.perf_counter()
        found = scene.search_codes(codes, k=K, threads=THREADS, recall=RECALL)[0][:, 0]
        seconds.append(time.perf_counter() - begin)
    exact = scene.search_codes(codes, k=K, threads=THREADS)[0][:, 0]
    finer = scene.search_codes(codes, k=K, threads=THREADS, recall=sections.RECALL)[0][:, 0]
    per = 1_000 / len(codes)
    return {
        "file bytes": float(path.stat().st_size),
        "open seconds": opened,
        "first 1,000 queries, seconds": per * seconds[0],
        "1,000 queries, seconds": per * median(seconds),
        "recall of this file's nearest": _share(found, exact),
        "recall of the nearest of int8": _share(found, nearest),
        _FINER: _share(finer, nearest),
        "landmark asked for": _share(found, landmarks),
    }


def _extend_growth(bench: Bench, path: Path, codes: NDArray[np.int8], recall: float) -> None:
    """Add the sealed map to the curves of `sections.growth` if they have no map of its size."""
    scene, settings = pm.open(path), bench.settings
    if any(point["landmarks"] == len(scene) for point in bench.results.growth):
        return
    for method, asked, reached in (
        ("exact", None, 1.0),
        ("approximate", sections.RECALL, recall),
    ):
        bench.results.growth.append(
            {
                "landmarks": len(scene),
                "threads": settings.threads,
                "method": method,
                "seconds": sections.seconds_per_query(scene, codes, settings, asked),
                "bytes": None,
                "file": path.stat().st_size / len(scene),
                "recall": reached,
            }
        )


def _share(found: NDArray[np.int64], expected: NDArray[np.int64]) -> float:
    return float((found == expected).mean())
