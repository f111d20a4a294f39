"""Whether grown landmarks are as hard to search as real ones."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from protomark.bench.grown import map_of, prototypes_of
from protomark.bench.peers import installed
from protomark.bench.results import Results
from protomark.bench.workload import Workload

PROBES = (1, 4, 16)
EFFORTS = (4, 16, 64)
_QUERIES = 2_000
_MOST = 100_000  # landmarks


def measure(workload: Workload, results: Results) -> None:
    """Recall@1 of FAISS on as many grown as real landmarks, with the same parameters."""
    if not installed("faiss"):
        return
    real, settings = workload.real, workload.settings
    n = min(len(real), _MOST)
    landmarks = np.random.default_rng(1).choice(n, min(_QUERIES, n), replace=False)
    rows = prototypes_of(real, workload.encoder, settings.dim, settings.build_threads)[:n]
    of_real = _recalls(workload, rows, workload.codes(real.queries(landmarks)))
    queries = workload.codes(workload.grown.queries(landmarks))
    of_grown = _recalls(workload, workload.prototypes(n), queries)
    results.resemblance = {name: [value, of_grown[name]] for name, value in of_real.items()}


def _recalls(
    workload: Workload, rows: NDArray[np.int8], codes: NDArray[np.int8]
) -> dict[str, float]:
    import faiss

    n, dim = rows.shape
    # Unaffected by which of two equally near rows is found.
    exact = map_of(workload.encoder, rows).search_codes(codes, k=1)[1][:, 0]
    values, asked = rows.astype(np.float32), codes.astype(np.float32)

    def recall(index: object) -> float:
        squared = index.search(asked, 1)[0][:, 0]  # type: ignore[attr-defined]
        return float((squared <= exact).mean())

    cells = faiss.IndexIVFFlat(faiss.IndexFlatL2(dim), dim, max(int(sqrt(n)), 1))
    cells.train(values)
    cells.add(values)
    found = {}
    for cells.nprobe in PROBES:
        found[f"IVF, nprobe {cells.nprobe}"] = recall(cells)
    graph = faiss.IndexHNSWFlat(dim, 8)
    graph.hnsw.efConstruction = 40
    graph.add(values)
    for effort in EFFORTS:
        graph.hnsw.efSearch = effort
        found[f"HNSW (M = 8), efSearch {effort}"] = recall(graph)
    return found
