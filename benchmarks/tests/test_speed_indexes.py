"""Cached indexes of peers: built once for the same rows, and unchanged when read again."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from protomark_bench.speed.peers.index import IndexCache, IndexQueries, TunableIndex

ROWS = np.arange(24, dtype=np.int8).reshape(8, 3)


def test_indexes_are_built_once_for_the_same_rows_and_parameters(tmp_path: Path) -> None:
    built: list[str] = []

    def get(
        cache: IndexCache, label: str, rows: NDArray[np.int8]
    ) -> tuple[NDArray[np.int8], float]:
        def build() -> NDArray[np.int8]:
            built.append(label)
            return rows + 1

        def write(index: NDArray[np.int8], path: Path) -> None:
            path.write_bytes(index.tobytes())

        def read(path: Path) -> NDArray[np.int8]:
            return np.frombuffer(path.read_bytes(), np.int8).reshape(rows.shape)

        return cache.get(label, "numpy", rows, build, write, read)

    cache = IndexCache(tmp_path / "new" / "folder")
    first, seconds = get(cache, "a", ROWS)
    again, same = get(IndexCache(tmp_path / "new" / "folder"), "a", ROWS)
    assert built == ["a"]
    assert (again == first).all()
    assert same == seconds > 0
    get(cache, "b", ROWS)
    get(cache, "b", ROWS[:7])
    get(cache, "b", ROWS[::-1])
    assert built == ["a", "b", "b", "b"]
    for facts in (tmp_path / "new" / "folder").glob("*.json"):
        facts.unlink()  # as after a run that was cut short
    get(cache, "a", ROWS)
    get(IndexCache(), "a", ROWS)
    get(IndexCache(), "a", ROWS)
    assert built == ["a", "b", "b", "b", "a", "a", "a"]


def test_a_build_that_fails_leaves_nothing_to_be_read(tmp_path: Path) -> None:
    def fail() -> int:
        raise KeyboardInterrupt

    cache = IndexCache(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        cache.get("a", "numpy", ROWS, fail, lambda index, path: None, lambda path: 1)
    made, _ = cache.get("a", "numpy", ROWS, lambda: 2, lambda index, path: None, lambda path: 1)
    assert made == 2


@pytest.mark.parametrize("graph", ["faiss", "lists", "hnswlib", "i8", "f32"])
def test_cached_graphs_answer_as_when_they_were_built(
    graph: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if graph in ("faiss", "lists"):
        pytest.importorskip("faiss")
        from protomark_bench.speed.peers import faiss_indexes

        monkeypatch.setattr(faiss_indexes, "_GRAPH_LISTS", 50)
        build = faiss_indexes.hnsw if graph == "faiss" else faiss_indexes.lists_by_graph
    elif graph == "hnswlib":
        pytest.importorskip("hnswlib")
        from protomark_bench.speed.peers import hnswlib_index

        build = hnswlib_index.hnsw
    else:
        pytest.importorskip("usearch")
        from protomark_bench.speed.peers import usearch_index

        build = partial(usearch_index.hnsw, dtype=graph)
    random = np.random.default_rng(5)
    rows = random.integers(-100, 100, (3_000, 32), dtype=np.int8)
    setting = (32, 16) if graph == "lists" else 64

    def get() -> TunableIndex:
        return build(rows, IndexQueries(rows[:200], 1, 1), cache=IndexCache(tmp_path))

    first, again = get(), get()
    assert again.seconds == first.seconds
    assert again.bytes == first.bytes
    answers = first.prepare(setting)(200)
    assert (answers == np.arange(200)).mean() > 0.95
    assert (again.prepare(setting)(200) == answers).all()
