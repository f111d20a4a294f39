"""Our own approximate search, as the bench sees any index."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from protomark import PrototypeMap
from protomark.bench.grown import map_of
from protomark.bench.peers.index import Index, K, Search, doubling
from protomark.bench.workload import Workload

APPROXIMATE = "Protomark, approximate"


def cells(
    workload: Workload,
    rows: NDArray[np.int8],
    codes: NDArray[np.int8],
    threads: int,
    build_threads: int,
) -> Index:
    """Inverted lists over the map's own cells; setting: cells searched."""
    scene = map_of(workload.encoder, rows)
    plain = _sealed_bytes(scene, workload.settings.scratch)
    scene.build_index(threads=build_threads)
    count = scene.index_cells

    def prepare(probes: int) -> Search:
        def run(q: int) -> NDArray[np.int64]:
            ids, _ = scene.search_codes(codes[:q], k=K, threads=threads, probes=probes)
            return ids[:, 0]

        return run

    indexed = _sealed_bytes(scene, workload.settings.scratch)
    return Index(
        prepare,
        [doubling(1, count)],
        indexed,
        "probes",
        f"{count:,} cells",
        more=(indexed - plain) / len(rows),
    )


def _sealed_bytes(scene: PrototypeMap, scratch: Path) -> int:
    """Of the map as it would be stored, less the encoder, which it holds whatever its size."""
    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        path = Path(folder) / "map.pmk"
        scene.seal(path)
        return path.stat().st_size - _encoder_bytes(path)


def _encoder_bytes(path: Path) -> int:
    import protomark as pm

    return dict(pm.file_sections(path))["encoder"]
