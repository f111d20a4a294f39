"""The sections encode, search, hamming, frame, add and growth, and the resemblance of data."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark_bench.machine import allocated_bytes, last_level_cache, shortage
from protomark_bench.speed.landmarks import Workload, map_of
from protomark_bench.speed.peers import installed
from protomark_bench.speed.peers.index import K
from protomark_bench.speed.race import Advance, Contender, Contest, race
from protomark_bench.speed.results import BenchResults
from protomark_bench.speed.settings import BenchSettings

ENCODERS, BATCH = ("freak", "orb"), 1_000
THREADS = (1, 2)  # threads of the sections frame and add
FRAME, RATIO, RECALL = 1_000, 0.8, 0.98
CACHES = 4  # a map this many times as large as the last-level cache is mostly read from memory
LEARNING_BYTES = 200  # approximate limit per landmark of a learning map with its index


@dataclass(frozen=True)
class Bench:
    """The data, settings and results of all sections.

    Attributes:
        workload: landmarks and queries.
        settings: sizes and time.
        results: results to which a section adds its figures.
        advance: called with the name of the next step.
    """

    workload: Workload
    settings: BenchSettings
    results: BenchResults
    advance: Advance

    def contest(self, contest: Contest, contenders: list[Contender], units: int) -> None:
        """Race the contenders of a contest, and add it to the results."""
        contest.timings = race(contenders, units, self.settings.pace, self.advance)
        self.results.contests.append(contest)

    def fits(self, what: str, memory: float) -> bool:
        """Whether there is enough memory; if not, the results tell so."""
        reason = shortage(memory)
        if reason:
            self.results.skipped.append(f"{what}: {reason}")
        return reason is None


def encode(bench: Bench) -> None:
    """Race the shipped FREAK and ORB networks, in batches of 1,000 and on a whole set."""
    workload, settings = bench.workload, bench.settings
    for name in ENCODERS:
        encoder = pm.Encoder.load(name)
        last = encoder.layers[-1]["weights"]
        work = encoder.multiply_adds - last.size + workload.dim * last.shape[1]
        descriptors = _descriptors(workload, encoder, settings.encoded)
        for size in (BATCH, settings.encoded):
            title = f"{name}, {size:,} at a time, {workload.dim}-d"
            contest = Contest("encode", title, "descriptor", settings.threads)
            contest.work = {"multiply_adds": float(work)}
            contenders = _networks(encoder, descriptors[:size], workload.dim, settings.threads)
            bench.contest(contest, contenders, size)


def _descriptors(workload: Workload, encoder: pm.Encoder, count: int) -> NDArray[np.uint8]:
    """Real descriptors if they are of this encoder's kind, else random bits."""
    rng = np.random.default_rng(0)
    if encoder.descriptor == workload.encoder.descriptor:
        return workload.real.descriptors[rng.integers(0, len(workload.real.descriptors), count)]
    return rng.integers(0, 256, (count, encoder.bits // 8), np.uint8)


def _networks(
    encoder: pm.Encoder, descriptors: NDArray[np.uint8], dim: int, threads: int
) -> list[Contender]:
    from protomark_bench.speed.peers import network

    layers = network.float_layers(encoder, dim)
    bits = network.bits_of(descriptors)
    runs: dict[str, Callable[[int], object]] = {
        "Protomark": lambda n: encoder.encode(descriptors[:n], dim=dim, threads=threads)
    }
    if installed("torch"):
        from protomark_bench.speed.peers import torch_network

        runs["PyTorch float"] = torch_network.runner(layers, bits)
    if installed("onnxruntime", "onnx"):
        from protomark_bench.speed.peers import onnx_network

        floats = bits.astype(np.float32)
        for name, model, inputs in (
            ("ONNX Runtime float", onnx_network.float_model(layers), floats),
            ("ONNX Runtime int8, static", onnx_network.static_model(layers), bits),
            ("ONNX Runtime int8, dynamic", onnx_network.dynamic_model(layers), bits),
        ):
            runs[name] = onnx_network.runner(model, inputs, threads)
    return [Contender(name, run, name == "Protomark", least=BATCH) for name, run in runs.items()]


def search(bench: Bench) -> None:
    """Race exact search, k = 2, with FAISS IndexFlatL2 on the same prototypes as float32."""
    workload, settings = bench.workload, bench.settings
    for n in settings.exact:
        contenders = _exact_searches(bench, n)
        title = f"exact, {n:,} landmarks, {workload.dim}-d, k = 2"
        size = float(n * workload.dim)
        contest = Contest("search", title, "query", settings.threads, n)
        contest.work = {"multiply_adds": size}
        bench.contest(contest, contenders, settings.queries)
    # A single query reads the whole map, here the largest one.
    alone = replace(contest, title=f"{title}, one query at a time", work={})
    if size >= CACHES * last_level_cache():
        alone.work = {"bytes": size}
    bench.contest(alone, contenders, 1)


def _exact_searches(bench: Bench, n: int) -> list[Contender]:
    workload, settings = bench.workload, bench.settings
    codes = workload.codes(workload.queries(n, settings.queries))
    contenders = [search_contender("Protomark", workload.map(n), codes, settings.threads)]
    if installed("faiss"):
        from protomark_bench.speed.peers import faiss_indexes

        flat = faiss_indexes.flat(workload.prototypes(n), codes)
        contenders.append(Contender("FAISS IndexFlatL2", flat, least=settings.queries))
    return contenders


def search_contender(
    name: str,
    scene: pm.PrototypeMap | pm.SealedMap,
    codes: NDArray[np.int8],
    threads: int,
    recall: float | None = None,
) -> Contender:
    """A contender that searches a map for the first codes, exactly or at a recall."""

    def run(q: int) -> None:
        scene.search_codes(codes[:q], k=K, threads=threads, recall=recall)

    return Contender(name, run, ours=True, least=64)


def hamming(bench: Bench) -> None:
    """Race prototypes with all descriptors in our search, OpenCV's and FAISS's; k = 2."""
    settings, observations = bench.settings, bench.workload.synthetic.observations
    for n in settings.exact:
        size = 3.0 * n * observations * bench.workload.encoder.bits // 8
        if not bench.fits(f"hamming, {n:,} landmarks", size):
            continue
        title = f"exact, {n:,} landmarks with {observations} descriptors each"
        contest = Contest("hamming", title, "query", settings.threads, n)
        # The work is that of prototypes, our fastest contender.
        contest.work = {"multiply_adds": float(n * bench.workload.dim)}
        bench.contest(contest, _hamming_searches(bench, n), settings.queries)


def _hamming_searches(bench: Bench, n: int) -> list[Contender]:
    workload, threads = bench.workload, bench.settings.threads
    queries = workload.queries(n, bench.settings.queries)
    rows = workload.synthetic.descriptors(n)
    prototypes = search_contender(
        "Protomark, prototypes", workload.map(n), workload.codes(queries), threads
    )
    contenders = [
        Contender(
            "Protomark, Hamming",
            lambda q: pm.hamming_search(queries[:q], rows, k=K, threads=threads),
            ours=True,
            least=64,
        )
    ]
    if installed("cv2"):
        from protomark_bench.speed.peers import opencv_matchers

        brute_force = opencv_matchers.brute_force(rows, queries)
        contenders.append(Contender("OpenCV BFMatcher", brute_force, least=16))
    if installed("faiss"):
        from protomark_bench.speed.peers import faiss_indexes

        flat = faiss_indexes.binary_flat(rows, queries)
        contenders.append(Contender("FAISS IndexBinaryFlat", flat, least=64))
    for contender in contenders:
        contender.facts["bytes"] = rows.nbytes / n
    prototypes.facts["bytes"] = workload.dim + 1
    return [prototypes, *contenders]


def frame(bench: Bench) -> None:
    """Race a frame of 1,000 descriptors: encoded, searched exactly or at a recall, ratio-tested."""
    workload, n = bench.workload, bench.settings.map
    bench.advance("map and index")
    indexed = map_of(workload.encoder, workload.prototypes(n))
    indexed.build_index(threads=bench.settings.build_threads)
    queries = workload.queries(n, FRAME)

    def run(scene: pm.PrototypeMap, threads: int, recall: float | None, _: int) -> None:
        scene.search(queries, k=K, ratio=RATIO, threads=threads, recall=recall)

    for threads in THREADS:
        contenders = [
            Contender(name, partial(run, scene, threads, recall), ours=True)
            for name, scene, recall in (
                ("Protomark, exact", workload.map(n), None),
                (f"Protomark, recall {RECALL}", indexed, RECALL),
            )
        ]
        title = f"{FRAME:,} descriptors encoded, searched among {n:,} landmarks, ratio-tested"
        bench.contest(Contest("frame", title, "frame", threads, n), contenders, 1)


def add(bench: Bench) -> None:
    """Race the addition of descriptors of random landmarks of the map with encoding alone."""
    workload, n, count = bench.workload, bench.settings.map, bench.settings.encoded
    bench.advance("map")
    scene = map_of(workload.encoder, workload.prototypes(n))
    ids = np.random.default_rng(0).integers(0, n, count)
    descriptors = workload.queries(n, count)

    def add_to_map(threads: int, q: int) -> None:
        scene.add(ids[:q], descriptors[:q], threads=threads)

    def encode_only(threads: int, q: int) -> None:
        workload.encoder.encode(descriptors[:q], dim=workload.dim, threads=threads)

    for threads in THREADS:
        contenders = [
            Contender("Protomark, add", partial(add_to_map, threads), ours=True, least=1_000),
            Contender("Protomark, encode alone", partial(encode_only, threads), least=1_000),
        ]
        title = f"observations of random landmarks, {n:,} in the map, {count:,} at a time"
        bench.contest(Contest("add", title, "observation", threads, n), contenders, count)


def growth(bench: Bench) -> None:
    """Measure time and memory of learning maps by size, searched exactly and approximately."""
    workload, settings = bench.workload, bench.settings
    for n in settings.growth:
        if not bench.fits(f"growth, {n:,} landmarks", n * LEARNING_BYTES):
            continue
        bench.advance(f"{n:,} landmarks")
        codes = workload.codes(workload.queries(n, settings.queries))
        rows = workload.prototypes(n)
        before = allocated_bytes()
        scene = map_of(workload.encoder, rows)
        scene.search_codes(codes[:1], k=K)
        used = _since(before, n)
        seconds = seconds_per_query(scene, codes, settings)
        point = {"landmarks": n, "threads": settings.threads}
        exact = {"method": "exact", "seconds": seconds, "bytes": used, "recall": 1.0}
        bench.results.growth.append(point | exact)

        bench.advance(f"{n:,} landmarks, approximate")
        nearest = scene.search_codes(codes, k=1, threads=settings.build_threads)[1]
        begin = time.perf_counter()
        scene.build_index(threads=settings.build_threads)
        approximate: dict[str, Any] = {
            "method": "approximate",
            "build": time.perf_counter() - begin,
        }
        found = scene.search_codes(codes, k=1, threads=settings.build_threads, recall=RECALL)[1]
        approximate["recall"] = float((found[:, 0] <= nearest[:, 0]).mean())
        approximate["seconds"] = seconds_per_query(scene, codes, settings, RECALL)
        approximate["bytes"] = used = _since(before, n)
        scene.drop_index()
        plain = _since(before, n)
        if used is not None and plain is not None:
            approximate["index"] = used - plain
        bench.results.growth.append(point | approximate)
        del scene, rows  # memory that is freed later would distort the next map's


def seconds_per_query(
    scene: pm.PrototypeMap | pm.SealedMap,
    codes: NDArray[np.int8],
    settings: BenchSettings,
    recall: float | None = None,
) -> float:
    """Seconds per query of a batch, exactly or at a recall, on `settings.threads`."""
    contender = search_contender("search", scene, codes, settings.threads, recall)
    return race([contender], len(codes), replace(settings.pace, rounds=3))[0].median


def _since(before: int | None, landmarks: int) -> float | None:
    """Bytes per landmark that the process has allocated since `before`."""
    now = allocated_bytes()
    return None if before is None or now is None else max(now - before, 0) / landmarks


def measure_resemblance(workload: Workload, limit: int = 100_000) -> dict[str, list[float]]:
    """Recall@1 of FAISS on real and on synthetic landmarks, by index."""
    if not installed("faiss"):
        return {}
    real = workload.real
    n = min(len(real), limit)
    landmarks = np.random.default_rng(1).choice(n, min(2_000, n), replace=False)
    rows = real.prototypes(workload.encoder, workload.dim, workload.build_threads)[:n]
    of_real = _faiss_recalls(workload, rows, real.queries(landmarks))
    queries = workload.synthetic.queries(landmarks)
    of_synthetic = _faiss_recalls(workload, workload.prototypes(n), queries)
    return {name: [recall, of_synthetic[name]] for name, recall in of_real.items()}


def _faiss_recalls(
    workload: Workload, rows: NDArray[np.int8], queries: NDArray[np.uint8]
) -> dict[str, float]:
    import faiss

    n, dim = rows.shape
    codes = workload.codes(queries)
    nearest = map_of(workload.encoder, rows).search_codes(codes, k=1)[0][:, 0]
    # Either of two equally near rows is right.
    exact = np.square(rows[nearest].astype(np.int32) - codes).sum(axis=1)
    values, asked = rows.astype(np.float32), codes.astype(np.float32)

    def recall(index: Any) -> float:
        return float((index.search(asked, 1)[0][:, 0] <= exact).mean())

    lists = faiss.IndexIVFFlat(faiss.IndexFlatL2(dim), dim, max(int(sqrt(n)), 1))
    lists.train(values)
    lists.add(values)
    found = {}
    for lists.nprobe in (1, 4, 16):
        found[f"IVF, nprobe {lists.nprobe}"] = recall(lists)
    graph = faiss.IndexHNSWFlat(dim, 8)
    graph.hnsw.efConstruction = 40
    graph.add(values)
    for effort in (4, 16, 64):
        graph.hnsw.efSearch = effort
        found[f"HNSW (M = 8), efSearch {effort}"] = recall(graph)
    return found
