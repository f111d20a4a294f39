"""Approximate search: every index at the fastest setting that finds enough."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.bench import ours
from protomark.bench.grown import map_of, prototypes_of
from protomark.bench.machine import lacks
from protomark.bench.peers import installed
from protomark.bench.peers.index import Builder, Index, Search
from protomark.bench.peers.shelf import Shelf
from protomark.bench.progress import Bar
from protomark.bench.race import Contender, race, turns
from protomark.bench.results import NOT_ASKED_FOR, Contest, Results
from protomark.bench.tuning import Trial, tune
from protomark.bench.workload import Workload

GOALS = (0.95, 0.98, 0.99)
BYTES = 1_000  # of a landmark, about: all indexes together but graphs
_FEW = 1_000_000  # landmarks for which FAISS's guide has few cells
QUERIES = 200  # that recall is measured on, unless they take over `_PATIENCE` times a trial's time
_PATIENCE = 4


@dataclass(frozen=True)
class _Ground:
    """What is searched.

    Attributes:
        section, title: of its contests.
        rows: (n, dim) prototypes.
        queries: (q, bits / 8) descriptors.
        codes: (q, dim), the same encoded.
        scene: an open map of the rows.
        descriptors: makes all descriptors of the landmarks.
    """

    section: str
    title: str
    rows: NDArray[np.int8]
    queries: NDArray[np.uint8]
    codes: NDArray[np.int8]
    scene: pm.PrototypeMap
    descriptors: Callable[[], NDArray[np.uint8]]


@dataclass
class _Entrant:
    """An index to build, and how far its answers are from the queries.

    Attributes:
        name: who.
        build: makes the index.
        right: (q,) answers -> whether each is as near as the exact one.
        least: fewest queries to time.
        memory: bytes a landmark that must be free beside `BYTES` while it is built.
        own: whether it is Protomark's.
        comparable: whether it searches what the others search.
        note: beside the index's own.
    """

    name: str
    build: Callable[[], Index]
    right: Callable[[NDArray[np.int64]], NDArray[np.bool_]]
    least: int = 64
    memory: int = 0
    own: bool = False
    comparable: bool = True
    note: str = ""


def run(workload: Workload, results: Results, bar: Bar) -> None:
    """Grown landmarks of every size."""
    settings = workload.settings
    _begin(workload, bar, "approximate", len(settings.approximate))
    for n in settings.approximate:
        reason = lacks(n * BYTES)
        if reason:
            results.skipped.append(f"approximate, {n:,} landmarks: {reason}")
            continue
        _contests(workload, results, bar, _grown(workload, n))


def run_real(workload: Workload, results: Results, bar: Bar) -> None:
    """Real landmarks."""
    _begin(workload, bar, "real", 1)
    reason = lacks(len(workload.real) * BYTES)
    if reason:
        results.skipped.append(f"real landmarks: {reason}")
    else:
        _contests(workload, results, bar, _real(workload))


def _begin(workload: Workload, bar: Bar, name: str, races: int) -> None:
    bar.begin(name, races * (10 + len(GOALS) * turns(11, workload.settings.pace)))


def _real(workload: Workload) -> _Ground:
    """All landmarks of the tracks; queries are observations kept out."""
    real, settings = workload.real, workload.settings
    n = len(real)
    rows = prototypes_of(real, workload.encoder, settings.dim, settings.build_threads)
    asked = np.random.default_rng(7).choice(n, min(settings.queries, n), replace=False)
    queries = real.queries(asked)
    return _Ground(
        "real",
        f"{n:,} real landmarks",
        rows,
        queries,
        workload.codes(queries),
        map_of(workload.encoder, rows),
        lambda: real.descriptors[real.map_rows],
    )


def _grown(workload: Workload, n: int) -> _Ground:
    queries = workload.queries(n, workload.settings.queries)
    return _Ground(
        "approximate",
        f"{n:,} landmarks",
        workload.prototypes(n),
        queries,
        workload.codes(queries),
        workload.map(n),
        lambda: workload.grown.descriptors(n),
    )


def _contests(workload: Workload, results: Results, bar: Bar, ground: _Ground) -> None:
    """Build, tune to recall@1 of 0.95, 0.98 and 0.99, then race at each."""
    settings = workload.settings
    n, asked = len(ground.rows), len(ground.queries)
    fields: dict[float, list[Contender]] = {
        goal: [_exact(ground.scene, ground.codes, settings.threads)] for goal in GOALS
    }
    for entrant in _entrants(workload, results, ground):
        bar.advance(f"{ground.title}, {entrant.name}")
        reason = lacks(n * entrant.memory)
        if reason:
            results.skipped.append(f"{entrant.name}, {ground.title}: {reason}")
            continue
        try:
            tuned = _tuned(entrant, n, asked, settings.tuned_on)
        except Exception as error:  # whatever a peer raises: the others go on
            results.skipped.append(f"{entrant.name}, {ground.title}: failed ({error})")
            continue
        for goal, contender in tuned:
            if contender is not None:
                fields[goal].append(contender)
            else:
                results.skipped.append(
                    f"{entrant.name}, {ground.title}: no setting reaches a recall of {goal}"
                )
    for goal, field in fields.items():
        results.contests.append(
            Contest(
                ground.section,
                f"recall@1 of at least {goal}, {ground.title}",
                "query",
                settings.threads,
                n,
                recall=goal,
                timings=race(field, asked, settings.pace, bar.advance),
            )
        )


def _exact(scene: pm.PrototypeMap, codes: NDArray[np.int8], threads: int) -> Contender:
    return Contender(
        "Protomark, exact",
        lambda q: scene.search_codes(codes[:q], k=2, threads=threads),
        ours=True,
        least=64,
        facts={"recall": 1.0, "bytes": codes.shape[1] + 1},
    )


def _entrants(
    workload: Workload,
    results: Results,
    ground: _Ground,
) -> list[_Entrant]:
    settings = workload.settings
    threads, build_threads = settings.threads, settings.build_threads
    rows, codes, (n, dim) = ground.rows, ground.codes, ground.rows.shape
    exact, _ = ground.scene.search_codes(codes, k=1, threads=build_threads)
    near = partial(_as_near, rows, codes, _squared(rows, codes, exact[:, 0]))
    found: list[_Entrant] = []

    def enter(name: str, build: Builder, memory: int = 0) -> None:
        entrant = _Entrant(name, lambda: build(rows, codes, threads, build_threads), near)
        entrant.memory = memory
        found.append(entrant)

    shelf = Shelf(settings.indexes)

    def enter_graph(graph: str, name: str, build: Callable[..., Index], memory: int) -> None:
        everywhere = ground.section == "real" or n <= settings.graphs_to or graph == "hnswlib"
        if graph in settings.graphs and everywhere:
            enter(name, partial(build, shelf=shelf), memory)
        else:
            results.skipped.append(f"{name}, {ground.title}: {NOT_ASKED_FOR} (`--graphs {graph}`)")

    build = partial(ours.cells, workload, rows, codes, threads, build_threads)
    found.append(_Entrant(ours.APPROXIMATE, build, near, own=True))
    if installed("faiss"):
        from protomark.bench.peers import faiss_indexes

        enter_graph("faiss", "FAISS HNSW", faiss_indexes.hnsw, 300)
        for parts in (settings.dim // 2, settings.dim):
            quantizer = partial(faiss_indexes.product_quantizer, parts=parts)
            enter(f"FAISS IVF, PQ{parts} fast scan", quantizer)
        enter("FAISS IVF, SQ8", faiss_indexes.scalar_quantizer)
        if n > _FEW:
            name = f"FAISS IVF, PQ{settings.dim} fast scan, cells by HNSW"
            enter_graph("faiss-cells", name, faiss_indexes.many_cells, 100)
    if installed("hnswlib"):
        from protomark.bench.peers import hnswlib_index

        enter_graph("hnswlib", "hnswlib", hnswlib_index.hnsw, 300)
    if installed("usearch"):
        from protomark.bench.peers import usearch_index

        # Beside the graph, the rows as float32 while it is built.
        for dtype, label, memory in (("i8", "int8", 200), ("f32", "float32", 300 + 4 * dim)):
            graph = partial(usearch_index.hnsw, dtype=dtype)
            enter_graph(f"usearch-{label}", f"USearch {label}", graph, memory)
    if installed("cv2"):
        from protomark.bench.peers import opencv_matchers

        enter("OpenCV FLANN kd-trees", opencv_matchers.kd_trees)
        if n <= settings.hashed:
            found.append(_hashed(workload, ground))
        else:
            results.skipped.append(
                f"OpenCV FLANN LSH, {ground.title}: only up to {settings.hashed:,}"
            )
    return found


def _hashed(workload: Workload, ground: _Ground) -> _Entrant:
    """FLANN's LSH, on all bits, against the exact answer among bits."""
    from protomark.bench.peers import opencv_matchers

    threads, build_threads = workload.settings.threads, workload.settings.build_threads
    rows, queries = ground.descriptors(), ground.queries
    _, distances = pm.hamming_search(queries, rows, k=1, threads=build_threads)
    return _Entrant(
        "OpenCV FLANN LSH on bits",
        lambda: opencv_matchers.lsh(rows, queries, threads, build_threads),
        partial(_as_near_in_bits, rows, queries, distances[:, 0]),
        least=16,
        comparable=False,
        note="all descriptors, against the nearest of them; ",
    )


def _tuned(
    entrant: _Entrant, n: int, queries: int, seconds: float
) -> list[tuple[float, Contender | None]]:
    """Build it, and find its setting for each goal."""
    began = time.perf_counter()
    index = entrant.build()
    built = time.perf_counter() - began if index.seconds is None else index.seconds
    trials = tune(
        index.lines,
        lambda setting: _trial(index.prepare(setting), entrant, queries, seconds),
        GOALS,
    )
    return [(goal, _contender(entrant, index, trials[goal], n, built)) for goal in GOALS]


def _contender(
    entrant: _Entrant, index: Index, trial: Trial[Any] | None, n: int, built: float
) -> Contender | None:
    if trial is None:
        return None
    facts = {
        "recall": trial.recall,
        "asked": trial.queries,
        "bytes": index.bytes / n,
        "build": built,
    }
    if index.more is not None:
        facts["more"] = index.more
    return Contender(
        entrant.name,
        # Prepared anew at each call: an index has one setting at a time, and serves every goal.
        lambda q: index.prepare(trial.setting)(q),
        ours=entrant.own,
        least=entrant.least,
        comparable=entrant.comparable,
        facts=facts,
        note=f"{entrant.note}{index.note}; {index.setting} {trial.setting}",
    )


def _trial(
    search: Search, entrant: _Entrant, queries: int, seconds: float
) -> tuple[float, float, int]:
    """Recall, seconds of a query, and queries asked: as many as the time allows."""
    few = min(entrant.least, queries)
    began = time.perf_counter()
    search(few)
    each = (time.perf_counter() - began) / few
    affordable = min(QUERIES, int(_PATIENCE * seconds / each))
    count = min(queries, max(few, affordable, int(seconds / each)))
    began = time.perf_counter()
    answers = search(count)
    each = (time.perf_counter() - began) / count
    return float(entrant.right(answers).mean()), each, count


def _squared(
    rows: NDArray[np.int8], codes: NDArray[np.int8], answers: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Squared distance of each query to its answer."""
    difference = rows[answers].astype(np.int64) - codes[: len(answers)]
    result: NDArray[np.int64] = (difference * difference).sum(axis=1)
    return result


def _as_near(
    rows: NDArray[np.int8],
    codes: NDArray[np.int8],
    exact: NDArray[np.int64],
    answers: NDArray[np.int64],
) -> NDArray[np.bool_]:
    known = _known(rows, answers)
    return known & (_squared(rows, codes, np.where(known, answers, 0)) <= exact[: len(answers)])


def _as_near_in_bits(
    rows: NDArray[np.uint8],
    queries: NDArray[np.uint8],
    exact: NDArray[np.int32],
    answers: NDArray[np.int64],
) -> NDArray[np.bool_]:
    known = _known(rows, answers)
    different = np.unpackbits(rows[np.where(known, answers, 0)] ^ queries[: len(answers)], axis=1)
    return known & (different.sum(axis=1) <= exact[: len(answers)])


def _known(rows: NDArray[np.generic], answers: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which answers are rows: peers say in several ways that they found nothing."""
    return (answers >= 0) & (answers < len(rows))
