"""Maps shared by several threads and processes: merged, split, searched while they change."""

from __future__ import annotations

import multiprocessing
import random
import sys
import threading
import time
from collections.abc import Callable
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import protomark as pm
from conftest import balanced_encoder, random_descriptors

observations = st.lists(st.tuples(st.integers(0, 12), st.integers(0, 30)), max_size=60)
spawn = multiprocessing.get_context("spawn")


def file_bytes(scene: pm.PrototypeMap, folder: Path) -> bytes:
    scene.save(folder / "scene.pmk")
    return (folder / "scene.pmk").read_bytes()


def build(
    encoder: pm.Encoder, observed: list[tuple[int, int]], appearance_bits: int
) -> pm.PrototypeMap:
    scene = pm.PrototypeMap(encoder, appearance_bits=appearance_bits)
    scene.add([i for i, _ in observed], random_descriptors(31)[[d for _, d in observed]])
    return scene


def place(scene: pm.PrototypeMap, positions: dict[int, float]) -> None:
    here = [i for i in positions if i in scene.ids]
    scene.set_positions(here, np.array([[positions[i]] * 3 for i in here]).reshape(-1, 3))


@pytest.fixture(scope="module")
def balanced() -> pm.Encoder:
    return balanced_encoder()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sharing")


@settings(max_examples=80, deadline=None)
@given(
    first=observations,
    second=observations,
    new_ids=st.dictionaries(st.integers(0, 12), st.integers(0, 20)),
    here=st.dictionaries(st.integers(0, 12), st.integers(1, 9)),
    there=st.dictionaries(st.integers(0, 12), st.integers(1, 9)),
    appearance_bits=st.sampled_from([0, 2, 12]),
)
def test_update_with_other_ids_equals_one_map(
    first: list[tuple[int, int]],
    second: list[tuple[int, int]],
    new_ids: dict[int, int],
    here: dict[int, int],
    there: dict[int, int],
    appearance_bits: int,
    balanced: pm.Encoder,
    folder: Path,
) -> None:
    scene, other = build(balanced, first, appearance_bits), build(balanced, second, appearance_bits)
    place(scene, here)
    place(other, there)
    unchanged = file_bytes(other, folder)
    theirs = {i: new_ids.get(i, i) for i in other.ids.tolist()}
    named = [i for i in new_ids if i in theirs]
    scene.merge_map(other, into=[new_ids[i] for i in named], source=named)
    assert file_bytes(other, folder) == unchanged

    joint = build(balanced, first + [(theirs[i], d) for i, d in second], appearance_bits)
    # Own positions stay; of several others the one of the smallest id is taken.
    expected = {theirs[i]: float(there[i]) for i in sorted(theirs, reverse=True) if i in there}
    expected |= {i: float(here[i]) for i in {i for i, _ in first} if i in here}
    place(joint, expected)
    assert file_bytes(scene, folder) == file_bytes(joint, folder)


def test_ids_of_merge_map_are_checked_before_anything_changes(
    encoder: pm.Encoder, tmp_path: Path
) -> None:
    scene, other = build(encoder, [(1, 0), (2, 1)], 0), build(encoder, [(1, 2), (5, 3)], 0)
    before = file_bytes(scene, tmp_path)
    calls: list[tuple[type[Exception], str, Any]] = [
        (KeyError, "landmark 2 is not in the map", {"into": [7, 8], "source": [1, 2]}),
        (ValueError, "5 of the other map is named twice", {"into": [7, 8], "source": [5, 5]}),
        (ValueError, "landmark id -1 is negative", {"into": [7, -1], "source": [1, 5]}),
        (ValueError, "1 landmark ids for 2 sources", {"into": [7], "source": [1, 5]}),
        (ValueError, "into and source go together", {"into": [7]}),
        (TypeError, "landmark ids", {"into": [0.5], "source": [1]}),
    ]
    for error, message, arguments in calls:
        with pytest.raises(error, match=message):
            scene.merge_map(other, **arguments)
        assert file_bytes(scene, tmp_path) == before
    with pytest.raises(ValueError, match="merged into itself"):
        scene.merge_map(scene, into=[9], source=[1])
    scene.merge_map(other, into=other.ids + scene.ids[-1] + 1, source=other.ids)
    np.testing.assert_array_equal(scene.ids, [1, 2, 4, 8])


def shard(folder: Path, part: int, parts: int, appearance_bits: int) -> None:
    """Builds and saves the map of every `parts`-th observation, in a separate process."""
    scene = pm.PrototypeMap(pm.Encoder.load(folder / "tiny.pme"), appearance_bits=appearance_bits)
    data = np.load(folder / "observations.npz")
    some = slice(part, None, parts)
    for ids, descriptors in zip(
        np.array_split(data["ids"][some], 5),
        np.array_split(data["descriptors"][some], 5),
        strict=True,
    ):
        scene.add(ids, descriptors, threads=2)
    scene.set_positions(scene.ids, np.outer(scene.ids, [1.0, 2.0, 3.0]))
    scene.save(folder / f"shard{part}.pmk")


@pytest.mark.parametrize("appearance_bits", [0, 6])
def test_shards_of_several_processes_join_to_the_same_bytes(
    appearance_bits: int, balanced: pm.Encoder, tmp_path: Path
) -> None:
    """Landmark 3 gets 255 observations, the limit of a prototype."""
    balanced.save(tmp_path / "tiny.pme")
    rng = np.random.default_rng(5)
    ids = rng.permutation(np.concatenate([rng.integers(100, 400, 3000), np.full(255, 3)]))
    descriptors = random_descriptors(len(ids), seed=6)
    if appearance_bits:
        descriptors[ids == 3] = descriptors[0]  # one look
    np.savez(tmp_path / "observations.npz", ids=ids, descriptors=descriptors)
    shard(tmp_path, 0, 1, appearance_bits)
    expected = (tmp_path / "shard0.pmk").read_bytes()

    processes = [
        spawn.Process(target=shard, args=(tmp_path, i, 3, appearance_bits)) for i in range(3)
    ]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
        assert process.exitcode == 0
    for order in ([0, 1, 2], [2, 0, 1]):
        whole = pm.PrototypeMap(balanced, appearance_bits=appearance_bits)
        for i in order:
            part = pm.open(tmp_path / f"shard{i}.pmk")
            assert isinstance(part, pm.PrototypeMap)
            whole.merge_map(part)
        assert whole.counts([3]) == [255]
        assert file_bytes(whole, tmp_path) == expected


def test_beyond_255_two_maps_join_to_the_same_bytes_in_either_order(
    encoder: pm.Encoder, tmp_path: Path
) -> None:
    """Halving rounds, so the order of more than two shards may change the result."""
    codes = np.random.default_rng(0).integers(-127, 128, (400, 12)).astype(np.int8)

    def half(part: int) -> pm.PrototypeMap:
        scene = pm.PrototypeMap(encoder)
        scene.add_codes(np.full(200, 3), codes[200 * part : 200 * (part + 1)])
        return scene

    one, other = half(0), half(1)
    one.merge_map(half(1))
    other.merge_map(half(0))
    assert one.counts([3]) == [200]
    assert file_bytes(one, tmp_path) == file_bytes(other, tmp_path)


# The quotient of a coordinate just below a border is rounded to the border.
@example(
    observed=[(2, 0)],
    boundaries=[],
    cell_size=2.0,
    placed={2: -5e-324},
    appearance_bits=0,
    order=random.Random(0),
)
@settings(max_examples=60, deadline=None)
@given(
    observed=observations,
    boundaries=st.lists(st.integers(-1, 14), max_size=5).map(sorted),
    cell_size=st.floats(0.1, 20),
    placed=st.dictionaries(st.integers(0, 12), st.floats(-50, 50)),
    appearance_bits=st.sampled_from([0, 12]),
    order=st.randoms(),
)
def test_parts_join_to_the_same_bytes(
    observed: list[tuple[int, int]],
    boundaries: list[int],
    cell_size: float,
    placed: dict[int, float],
    appearance_bits: int,
    order: Any,
    balanced: pm.Encoder,
    folder: Path,
) -> None:
    scene = build(balanced, observed, appearance_bits)
    place(scene, placed)
    before = file_bytes(scene, folder)
    parts = scene.split_by_id(boundaries)
    assert [len(part) for part in parts] == [
        len(ids) for ids in np.split(scene.ids, np.searchsorted(scene.ids, boundaries))
    ]
    tiles = scene.split_by_space(cell_size)
    known = scene.ids.tolist()
    assert all(len(tile) for tile in tiles.values())
    for cell, tile in tiles.items():
        inside = [i for i in known if i in placed and cell == (placed[i] // cell_size,) * 3]
        outside = [i for i in known if i not in placed]
        np.testing.assert_array_equal(tile.ids, outside if cell is None else inside)
    assert list(tiles) == sorted(tiles, key=lambda cell: (cell is None, cell))
    for some in (parts, list(tiles.values())):
        whole = pm.PrototypeMap(balanced, appearance_bits=appearance_bits)
        order.shuffle(some)
        for part in some:
            whole.merge_map(part)
        assert file_bytes(whole, folder) == before
    assert file_bytes(scene, folder) == before


def test_parts_have_no_index_and_answer_alike(encoder: pm.Encoder, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    scene = pm.PrototypeMap(encoder)
    scene.add_codes(np.arange(500), rng.integers(-127, 128, (500, 12)).astype(np.int8))
    scene.build_index()
    low, high = scene.split_by_id([200])
    assert low.nlist == high.nlist == 0
    queries = rng.integers(-127, 128, (20, 12)).astype(np.int8)
    ids, _ = scene.search_codes(queries, k=1)
    answers = [part.search_codes(queries, k=1) for part in (low, high)]
    best = np.argmin([d[:, 0] for _, d in answers], axis=0)
    np.testing.assert_array_equal(
        ids[:, 0], np.array([i[:, 0] for i, _ in answers])[best, range(20)]
    )
    low.merge_map(high)
    scene.drop_index()
    assert file_bytes(low, tmp_path) == file_bytes(scene, tmp_path)


def test_what_cannot_be_split_is_refused(encoder: pm.Encoder) -> None:
    scene = build(encoder, [(1, 0), (2, 1)], 0)
    scene.set_positions([1], np.array([[1e300, 0, 0]]))
    with pytest.raises(ValueError, match="boundaries of parts must ascend"):
        scene.split_by_id([5, 4])
    for size in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="must be above 0 and finite"):
            scene.split_by_space(size)
    with pytest.raises(ValueError, match="too small for the extent"):
        scene.split_by_space(1.0)
    with pytest.raises(TypeError):
        scene.split_by_id(1.0)  # type: ignore[call-overload]
    assert [len(part) for part in pm.PrototypeMap(encoder).split_by_id([])] == [0]
    assert pm.PrototypeMap(encoder).split_by_space(1.0) == {}


def seconds_of(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def test_who_waits_for_the_map_does_not_hold_the_interpreter(encoder: pm.Encoder) -> None:
    """Python threads continue while a change waits for a search and a reader for the change."""
    rng = np.random.default_rng(3)
    scene = pm.PrototypeMap(encoder)
    ids = np.arange(20_000)
    scene.add_codes(ids, rng.integers(-127, 128, (len(ids), 12)).astype(np.int8))
    queries = rng.integers(-127, 128, (2_000, 12)).astype(np.int8)
    # Half a second on any machine.
    repeats = 1 + int(0.5 / seconds_of(lambda: scene.search_codes(queries)))
    queries = np.tile(queries, (repeats, 1))
    code = np.ones((1, 12), np.int8)
    questions: list[Callable[[], object]] = [
        lambda: len(scene),
        lambda: scene.prototype_count,
        lambda: scene.nlist,
        lambda: scene.ids,
        lambda: scene.counts([0]),
        lambda: scene.prototypes([0]),
        lambda: scene.positions([0]),
        lambda: scene.appearances(0),
        lambda: scene.appearance_counts(0),
        lambda: repr(scene),
    ]
    threads = [threading.Thread(target=scene.search_codes, args=(queries,))]
    threads[0].start()
    time.sleep(0.05)
    threads.append(threading.Thread(target=scene.add_codes, args=([0], code)))
    threads[1].start()
    time.sleep(0.05)
    threads += [threading.Thread(target=question) for question in questions]
    begin = time.perf_counter()
    for thread in threads[2:]:
        thread.start()
    started = time.perf_counter()
    assert threads[0].is_alive(), "the search was over too soon to wait for"
    assert all(thread.is_alive() for thread in threads)
    assert started - begin < 0.3
    for thread in threads:
        thread.join()


def mapped_bytes(path: Path) -> dict[str, int]:
    """Resident and proportional bytes of this process's mappings of a file."""
    total = {"Rss": 0, "Pss": 0}
    ours = False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        name, _, rest = line.partition(":")
        if "-" in line.split(" ")[0]:
            ours = line.endswith(str(path))
        elif ours and name in total:
            total[name] += 1024 * int(rest.split()[0])
    return total


def search_and_measure(path: Path, barrier: Barrier, results: Any) -> None:
    """Reads the whole map and reports its bytes in memory while other processes have it open."""
    scene = pm.open(path)
    scene.search_codes(np.ones((1, scene.dim), np.int8))
    barrier.wait()
    results.put(mapped_bytes(path))
    barrier.wait()


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_processes_share_the_pages_of_a_sealed_map(encoder: pm.Encoder, tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    scene = pm.PrototypeMap(encoder)
    n = 200_000
    scene.add_codes(np.arange(n), rng.integers(-127, 128, (n, 12)).astype(np.int8))
    path = tmp_path / "scene.sealed.pmk"
    scene.seal(path)
    readers = 4
    barrier, results = spawn.Barrier(readers), spawn.Queue()
    processes = [
        spawn.Process(target=search_and_measure, args=(path, barrier, results))
        for _ in range(readers)
    ]
    for process in processes:
        process.start()
    measured = [results.get(timeout=60) for _ in processes]
    for process in processes:
        process.join()
    prototypes = 12 * n
    assert all(one["Rss"] >= prototypes for one in measured)
    # Each has it in memory, and together they have it once.
    assert sum(one["Pss"] for one in measured) < 1.3 * path.stat().st_size
