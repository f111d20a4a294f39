"""The sections approximate and real: every index at its fastest setting with enough recall."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark_bench.machine import shortage
from protomark_bench.speed.landmarks import map_of
from protomark_bench.speed.peers import installed
from protomark_bench.speed.peers.index import IndexCache, IndexQueries, K, Search, TunableIndex
from protomark_bench.speed.race import Contender, Contest
from protomark_bench.speed.sections import Bench, search_contender

GOALS = (0.95, 0.98, 0.99)
OURS = "Protomark, approximate"
NOT_NAMED = "not named by --graphs"
_BYTES = 1_000  # per landmark, about, of all indexes together without graphs
_SMALL = 1_000_000  # landmarks up to which FAISS's guide recommends lists without a graph
# Number of queries to measure recall on, unless they take over `_PATIENCE` times a trial's time.
_RECALL_QUERIES, _PATIENCE = 200, 4


@dataclass(frozen=True)
class _SearchedSet:
    """Landmarks to search, and queries.

    Attributes:
        section, title: section and title of the contests.
        rows: (n, dim) prototypes.
        queries: (q, bits / 8) descriptors.
        scene: a learning map of the rows.
        descriptors: returns all descriptors of the landmarks.
    """

    section: str
    title: str
    rows: NDArray[np.int8]
    queries: NDArray[np.uint8]
    scene: pm.PrototypeMap
    descriptors: Callable[[], NDArray[np.uint8]]


@dataclass
class _Candidate:
    """An index to build, and a check of its answers.

    Attributes:
        name: name of the index.
        build: builds the index.
        right: tells whether each of the answers (q,) is as near as the exact one.
        least: smallest number of queries to time.
        memory: bytes per landmark beside `_BYTES` that building takes.
        ours: whether it is Protomark's.
        comparable: whether it searches the same vectors as the others.
        note: text before the note of the index.
    """

    name: str
    build: Callable[[], TunableIndex]
    right: Callable[[NDArray[np.int64]], NDArray[np.bool_]]
    least: int = 64
    memory: int = 0
    ours: bool = False
    comparable: bool = True
    note: str = ""


@dataclass(frozen=True)
class IndexTrial:
    """Recall and time of an index at a setting.

    Attributes:
        setting: the setting.
        recall: share of queries whose nearest vector it finds.
        seconds: seconds per query.
        queries: number of queries for the recall.
    """

    setting: Any
    recall: float
    seconds: float
    queries: int


def approximate(bench: Bench) -> None:
    """Race searches of synthetic landmarks of every size."""
    workload = bench.workload
    for n in bench.settings.approximate:
        if bench.fits(f"approximate, {n:,} landmarks", n * _BYTES):
            searched = _SearchedSet(
                "approximate",
                f"{n:,} landmarks",
                workload.prototypes(n),
                workload.queries(n, bench.settings.queries),
                workload.map(n),
                partial(workload.synthetic.descriptors, n),
            )
            _contests(bench, searched)


def real(bench: Bench) -> None:
    """Race searches of the tracks' landmarks; queries are held-out observations."""
    workload, landmarks = bench.workload, bench.workload.real
    n = len(landmarks)
    if not bench.fits("real landmarks", n * _BYTES):
        return
    rows = landmarks.prototypes(workload.encoder, workload.dim, workload.build_threads)
    count = min(bench.settings.queries, n)
    asked = np.random.default_rng(7).choice(n, count, replace=False)
    searched = _SearchedSet(
        "real",
        f"{n:,} real landmarks",
        rows,
        landmarks.queries(asked),
        map_of(workload.encoder, rows),
        lambda: landmarks.descriptors[landmarks.in_map],
    )
    _contests(bench, searched)


def _contests(bench: Bench, searched: _SearchedSet) -> None:
    """Build every index, tune it to each recall of `GOALS`, and race all of them at each."""
    settings, skipped = bench.settings, bench.results.skipped
    n, asked = len(searched.rows), len(searched.queries)
    codes = bench.workload.codes(searched.queries)
    exact = search_contender("Protomark, exact", searched.scene, codes, settings.threads)
    exact.facts = {"recall": 1.0, "bytes": codes.shape[1] + 1}
    fields: dict[float, list[Contender]] = {goal: [exact] for goal in GOALS}
    for candidate in _candidates(bench, searched, codes):
        what = f"{candidate.name}, {searched.title}"
        bench.advance(what)
        reason = shortage(n * candidate.memory)
        if reason:
            skipped.append(f"{what}: {reason}")
            continue
        try:
            tuned = _tuned(candidate, n, asked, settings.trial)
        except Exception as error:  # a peer may raise anything; the others continue
            skipped.append(f"{what}: failed ({error})")
            continue
        for goal, contender in tuned.items():
            if contender is None:
                skipped.append(f"{what}: no setting reaches a recall of {goal}")
            else:
                fields[goal].append(contender)
    for goal, contenders in fields.items():
        title = f"recall@1 of at least {goal}, {searched.title}"
        contest = Contest(searched.section, title, "query", settings.threads, n, recall=goal)
        bench.contest(contest, contenders, asked)


def _candidates(bench: Bench, searched: _SearchedSet, codes: NDArray[np.int8]) -> list[_Candidate]:
    settings = bench.settings
    rows, (n, dim) = searched.rows, searched.rows.shape
    asked = IndexQueries(codes, settings.threads, settings.build_threads)
    nearest, _ = searched.scene.search_codes(codes, k=1, threads=settings.build_threads)
    near = partial(_as_near, rows, codes, _squared(rows, codes, nearest[:, 0]))
    cache = IndexCache(settings.indexes)
    ours = partial(_inverted_lists, bench, rows, asked)
    found = [_Candidate(OURS, ours, near, ours=True)]

    def enter(name: str, build: Callable[..., TunableIndex], **options: Any) -> None:
        found.append(_Candidate(name, partial(build, rows, asked, **options), near))

    def enter_graph(
        graph: str, name: str, build: Callable[..., TunableIndex], memory: int, **options: Any
    ) -> None:
        small = searched.section == "real" or n <= settings.graphs_limit
        if graph in settings.graphs and (small or graph == "hnswlib"):
            enter(name, build, cache=cache, **options)
            found[-1].memory = memory
        else:
            bench.results.skipped.append(f"{name}, {searched.title}: {NOT_NAMED}")

    if installed("faiss"):
        from protomark_bench.speed.peers import faiss_indexes as faiss

        enter_graph("faiss", "FAISS HNSW", faiss.hnsw, 300)
        for parts in (dim // 2, dim):
            enter(f"FAISS IVF, PQ{parts} fast scan", faiss.product_quantizer, parts=parts)
        enter("FAISS IVF, SQ8", faiss.scalar_quantizer)
        if n > _SMALL:
            name = f"FAISS IVF, PQ{dim} fast scan, lists by HNSW"
            enter_graph("faiss-lists", name, faiss.lists_by_graph, 100)
    if installed("hnswlib"):
        from protomark_bench.speed.peers import hnswlib_index

        enter_graph("hnswlib", "hnswlib", hnswlib_index.hnsw, 300)
    if installed("usearch"):
        from protomark_bench.speed.peers import usearch_index

        # Building takes memory for the graph, and for the rows as float32.
        for dtype, label, memory in (("i8", "int8", 200), ("f32", "float32", 300 + 4 * dim)):
            name = f"USearch {label}"
            enter_graph(f"usearch-{label}", name, usearch_index.hnsw, memory, dtype=dtype)
    if installed("cv2"):
        from protomark_bench.speed.peers import opencv_matchers

        enter("OpenCV FLANN kd-trees", opencv_matchers.kd_trees)
        if n <= settings.lsh_limit:
            found.append(_hashed(bench, searched))
        else:
            limit = f"only up to {settings.lsh_limit:,}"
            bench.results.skipped.append(f"OpenCV FLANN LSH, {searched.title}: {limit}")
    return found


def _inverted_lists(bench: Bench, rows: NDArray[np.int8], asked: IndexQueries) -> TunableIndex:
    """Protomark's approximate search, whose setting is the number of lists to search."""
    scene = map_of(bench.workload.encoder, rows)
    without_index = _sealed_bytes(scene)
    scene.build_index(threads=asked.build_threads)
    nlist = scene.nlist

    def prepare(nprobe: int) -> Search:
        def run(q: int) -> NDArray[np.int64]:
            codes = asked.codes[:q]
            return scene.search_codes(codes, k=K, threads=asked.threads, nprobe=nprobe)[0][:, 0]

        return run

    size = _sealed_bytes(scene)
    more = (size - without_index) / len(rows)
    return TunableIndex(prepare, nlist, size, "nprobe", f"nlist {nlist:,}", more=more)


def _sealed_bytes(scene: pm.PrototypeMap) -> int:
    """Size of the sealed map without the encoder, whose size is constant."""
    with tempfile.TemporaryDirectory(prefix="protomark-") as folder:
        path = Path(folder) / "map.pmk"
        scene.seal(path)
        return path.stat().st_size - dict(pm.file_sections(path))["encoder"]


def _hashed(bench: Bench, searched: _SearchedSet) -> _Candidate:
    """FLANN's LSH on all bits, compared with the exact Hamming search."""
    from protomark_bench.speed.peers import opencv_matchers

    rows, queries = searched.descriptors(), searched.queries
    threads = bench.settings.build_threads
    _, distances = pm.hamming_search(queries, rows, k=1, threads=threads)
    return _Candidate(
        "OpenCV FLANN LSH on bits",
        partial(opencv_matchers.lsh, rows, queries),
        partial(_as_near_in_bits, rows, queries, distances[:, 0]),
        least=16,
        comparable=False,
        note="all descriptors, against the nearest of them; ",
    )


def _tuned(
    candidate: _Candidate, n: int, queries: int, seconds: float
) -> dict[float, Contender | None]:
    """Build an index and find its setting for each goal."""
    begin = time.perf_counter()
    index = candidate.build()
    built = time.perf_counter() - begin if index.seconds is None else index.seconds

    def measure(setting: Any) -> IndexTrial:
        return _trial(setting, index.prepare(setting), candidate, queries, seconds)

    result: dict[float, Contender | None] = {}
    for goal, trial in tune(index.lines, measure, GOALS).items():
        if trial is None:
            result[goal] = None
            continue
        facts = {"recall": trial.recall, "asked": trial.queries, "bytes": index.bytes / n}
        facts["build"] = built
        if index.more is not None:
            facts["more"] = index.more
        result[goal] = Contender(
            candidate.name,
            # An index has one setting at a time, so each call prepares that of its goal.
            lambda q, setting=trial.setting: index.prepare(setting)(q),  # type: ignore[misc]
            ours=candidate.ours,
            least=candidate.least,
            comparable=candidate.comparable,
            facts=facts,
            note=f"{candidate.note}{index.note}; {index.setting} {trial.setting}",
        )
    return result


def tune(
    lines: Sequence[Sequence[Any]],
    measure: Callable[[Any], IndexTrial],
    goals: Sequence[float],
) -> dict[float, IndexTrial | None]:
    """The fastest setting for each recall goal, None if no setting reaches it.

    Args:
        lines: settings, in lines along which recall and time increase; a line ends as soon as it
            reaches the highest goal, or takes ten times as long as another setting that does.
        measure: measures a setting.
        goals: recalls to reach.
    """
    trials: list[IndexTrial] = []
    for line in lines:
        for setting in line:
            trial = measure(setting)
            trials.append(trial)
            enough = [t.seconds for t in trials if t.recall >= max(goals)]
            if trial.recall >= max(goals) or (enough and trial.seconds > 10 * min(enough)):
                break
    return {
        goal: min((t for t in trials if t.recall >= goal), key=lambda t: t.seconds, default=None)
        for goal in goals
    }


def _trial(
    setting: Any, search: Search, candidate: _Candidate, queries: int, seconds: float
) -> IndexTrial:
    """Measure recall and time of a setting, on as many queries as the time allows."""
    least = min(candidate.least, queries)
    begin = time.perf_counter()
    search(least)
    each = (time.perf_counter() - begin) / least
    affordable = min(_RECALL_QUERIES, int(_PATIENCE * seconds / each))
    count = min(queries, max(least, affordable, int(seconds / each)))
    begin = time.perf_counter()
    answers = search(count)
    each = (time.perf_counter() - begin) / count
    return IndexTrial(setting, float(candidate.right(answers).mean()), each, count)


def _squared(
    rows: NDArray[np.int8], codes: NDArray[np.int8], answers: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Squared distance of each query from its answer."""
    difference = rows[answers].astype(np.int64) - codes[: len(answers)]
    result: NDArray[np.int64] = (difference * difference).sum(axis=1)
    return result


def _as_near(
    rows: NDArray[np.int8],
    codes: NDArray[np.int8],
    exact: NDArray[np.int64],
    answers: NDArray[np.int64],
) -> NDArray[np.bool_]:
    valid = _valid(rows, answers)
    return valid & (_squared(rows, codes, np.where(valid, answers, 0)) <= exact[: len(answers)])


def _as_near_in_bits(
    rows: NDArray[np.uint8],
    queries: NDArray[np.uint8],
    exact: NDArray[np.int32],
    answers: NDArray[np.int64],
) -> NDArray[np.bool_]:
    valid = _valid(rows, answers)
    different = np.unpackbits(rows[np.where(valid, answers, 0)] ^ queries[: len(answers)], axis=1)
    return valid & (different.sum(axis=1) <= exact[: len(answers)])


def _valid(rows: NDArray[np.generic], answers: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether each answer is a row, as peers have different values for no answer."""
    return (answers >= 0) & (answers < len(rows))
