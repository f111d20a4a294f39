"""Invariant 1: prototypes are exact after any sequence of changes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import protomark as pm
from conftest import NO_DISTANCE, random_descriptors, rounded


class Reference:
    """Eq. 1 and Eq. 2 in plain NumPy: a sum and a count per landmark, halved at 255."""

    def __init__(self) -> None:
        self.sums: dict[int, Any] = {}
        self.counts: dict[int, int] = {}

    def add(self, ids: Any, codes: Any) -> None:
        for i, code in zip(ids, codes.astype(np.int64), strict=True):
            i = int(i)
            if self.counts.get(i, 0) == 255:
                self.sums[i] = np.trunc(self.sums[i] / 2).astype(np.int64)
                self.counts[i] = 127
            self.sums[i] = self.sums.get(i, 0) + code
            self.counts[i] = self.counts.get(i, 0) + 1

    def means(self) -> Any:
        return np.array([self.sums[i] / self.counts[i] for i in sorted(self.sums)])


def file_bytes(scene: pm.PrototypeMap, folder: Path) -> bytes:
    scene.save(folder / "scene.pmk")
    return (folder / "scene.pmk").read_bytes()


def assert_equals(scene: pm.PrototypeMap, reference: Reference) -> None:
    ids = sorted(reference.sums)
    np.testing.assert_array_equal(scene.ids, ids)
    if ids:
        np.testing.assert_array_equal(scene.counts(ids), [reference.counts[i] for i in ids])
        np.testing.assert_array_equal(scene.prototypes(ids), reference.means().astype(np.float32))


one = st.tuples(st.integers(0, 12), st.integers(0, 30))
# Of two, none sees a landmark more than 255 times, from where on it forgets.
observations = st.lists(one, max_size=80) | st.lists(
    st.tuples(one, st.sampled_from([1, 3, 14, 17])), max_size=7
).map(lambda runs: [seen for seen, times in runs for _ in range(times)])


@settings(max_examples=60, deadline=None)
@given(observed=observations, order=st.randoms(), cuts=st.lists(st.integers(0, 80), max_size=4))
def test_any_order_and_any_batches_give_the_same_bytes(
    observed: list[tuple[int, int]],
    order: Any,
    cuts: list[int],
    encoder: pm.Encoder,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    folder = tmp_path_factory.mktemp("map")
    pool = random_descriptors(31)
    ids = np.array([i for i, _ in observed], np.int64)
    descriptors = pool[[d for _, d in observed]]
    at_once = pm.PrototypeMap(encoder)
    at_once.add(ids, descriptors, threads=2)
    reference = Reference()
    reference.add(ids, encoder.encode(descriptors))
    assert_equals(at_once, reference)

    rows = list(range(len(ids)))
    order.shuffle(rows)
    piecewise = pm.PrototypeMap(encoder)
    for part in np.split(np.array(rows, np.int64), sorted(c for c in cuts if c < len(rows))):
        piecewise.add(ids[part], descriptors[part])
    assert file_bytes(piecewise, folder) == file_bytes(at_once, folder)

    # Built in two places and joined.
    here, there = pm.PrototypeMap(encoder), pm.PrototypeMap(encoder)
    here.add(ids[::2], descriptors[::2])
    there.add(ids[1::2], descriptors[1::2])
    here.merge_map(there)
    assert file_bytes(here, folder) == file_bytes(at_once, folder)


@settings(max_examples=60, deadline=None)
@given(first=observations, second=observations)
def test_removing_what_was_added_gives_the_same_bytes(
    first: list[tuple[int, int]],
    second: list[tuple[int, int]],
    encoder: pm.Encoder,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    folder = tmp_path_factory.mktemp("map")
    pool = random_descriptors(31)
    scene = pm.PrototypeMap(encoder, dim=5)
    scene.add([i for i, _ in first], pool[[d for _, d in first]])
    before = file_bytes(scene, folder)
    scene.add([i for i, _ in second], pool[[d for _, d in second]])
    scene.subtract([i for i, _ in second], pool[[d for _, d in second]])
    assert file_bytes(scene, folder) == before


@settings(max_examples=60, deadline=None)
@given(observed=observations, pairs=st.permutations(range(13)))
def test_merging_equals_joint_construction(
    observed: list[tuple[int, int]],
    pairs: list[int],
    encoder: pm.Encoder,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    folder = tmp_path_factory.mktemp("map")
    pool = random_descriptors(31)
    ids = np.array([i for i, _ in observed], np.int64)
    descriptors = pool[[d for _, d in observed]]
    there = set(ids.tolist())
    joins = [
        (a, b) for a, b in zip(pairs[::2], pairs[1::2], strict=False) if a in there and b in there
    ]
    scene = pm.PrototypeMap(encoder)
    scene.add(ids, descriptors)
    scene.merge_landmarks([a for a, _ in joins], [b for _, b in joins])
    new_id = {b: a for a, b in joins}
    joint = pm.PrototypeMap(encoder)
    joint.add([new_id.get(int(i), int(i)) for i in ids], descriptors)
    assert file_bytes(scene, folder) == file_bytes(joint, folder)


def test_halving_at_255(encoder: pm.Encoder) -> None:
    descriptors = random_descriptors(700)
    ids = np.full(700, 3)
    scene, reference = pm.PrototypeMap(encoder), Reference()
    counts = []
    for begin in range(0, 700, 35):
        part = slice(begin, begin + 35)
        scene.add(ids[part], descriptors[part])
        reference.add(ids[part], encoder.encode(descriptors[part]))
        assert_equals(scene, reference)
        counts.append(int(scene.counts([3])[0]))
    assert max(counts) <= 255
    assert counts[7] == 127 + 280 - 255


def test_every_count_up_and_down(encoder: pm.Encoder) -> None:
    descriptors = random_descriptors(255)
    codes = encoder.encode(descriptors).astype(np.int64)
    scene = pm.PrototypeMap(encoder)

    def assert_first(n: int) -> None:
        assert scene.counts([3])[0] == n
        expected = (codes[:n].sum(0) / n).astype(np.float32)
        np.testing.assert_array_equal(scene.prototypes([3])[0], expected)

    for n in range(255):
        scene.add([3], descriptors[n : n + 1])
        assert_first(n + 1)
    for n in range(254, 0, -1):
        scene.subtract([3], descriptors[n : n + 1])
        assert_first(n)


def test_merging_above_255_halves_once(encoder: pm.Encoder) -> None:
    descriptors = random_descriptors(400)
    scene = pm.PrototypeMap(encoder)
    scene.add(np.repeat([1, 2], 200), descriptors)
    sums = encoder.encode(descriptors).astype(np.int64).sum(0)
    scene.merge_landmarks(1, 2)
    assert scene.counts([1])[0] == 200
    np.testing.assert_array_equal(
        scene.prototypes([1])[0], (np.trunc(sums / 2) / 200).astype(np.float32)
    )


def test_extreme_codes_fit(encoder: pm.Encoder) -> None:
    scene = pm.PrototypeMap(encoder, dim=5)
    for value in (127, -127):
        scene.add_codes(np.full(255, value + 127), np.full((255, 5), value, np.int8))
        np.testing.assert_array_equal(scene.prototypes([value + 127]), np.full((1, 5), value))
    with pytest.raises(ValueError, match="codes must be -127 to 127"):
        scene.add_codes([1], np.full((1, 5), -128, np.int8))


@settings(max_examples=40, deadline=None)
@given(
    n=st.integers(0, 60),
    k=st.integers(1, 4),
    dim=st.sampled_from([5, 12]),
    values=st.integers(1, 127),
    max_distance=st.none() | st.integers(0, 90_000),
    ratio=st.none() | st.floats(0.25, 1),
    seed=st.integers(0, 2**32 - 1),
)
def test_search_equals_sorting(
    n: int,
    k: int,
    dim: int,
    values: int,
    max_distance: int | None,
    ratio: float | None,
    seed: int,
    encoder: pm.Encoder,
) -> None:
    rng = np.random.default_rng(seed)
    scene = pm.PrototypeMap(encoder, dim=dim)
    all_ids = rng.choice(1000, n, replace=False)
    for _ in range(2):
        scene.add_codes(all_ids, rng.integers(-values, values + 1, (n, dim)).astype(np.int8))
    scene.remove(all_ids[: n // 3])
    queries = rng.integers(-values, values + 1, (9, dim)).astype(np.int8)
    ids, distances = scene.search_codes(
        queries, k=k, max_distance=max_distance, ratio=ratio, threads=2
    )

    known = scene.ids
    prototypes = rounded(scene.prototypes(known))
    for q, query in enumerate(queries.astype(np.int64)):
        squared = ((prototypes - query) ** 2).sum(1)
        order = np.argsort(squared, kind="stable")
        keep = True
        if ratio is not None and len(order) > 1:
            keep = float(squared[order[0]]) < ratio * ratio * float(squared[order[1]])
        limit = NO_DISTANCE if max_distance is None else max_distance
        expected = [(known[o], squared[o]) for o in order[:k] if keep and squared[o] <= limit]
        expected += [(-1, NO_DISTANCE)] * (k - len(expected))
        np.testing.assert_array_equal(ids[q], [i for i, _ in expected])
        np.testing.assert_array_equal(distances[q], [s for _, s in expected])
    assert distances.dtype == np.int32


def test_a_neighbour_at_just_the_limit_is_reported(encoder: pm.Encoder) -> None:
    """A regression: rounded root distances lost half of the matches."""
    rng = np.random.default_rng(3)
    scene = pm.PrototypeMap(encoder)
    scene.add_codes(np.arange(500), rng.integers(-127, 128, (500, 12)).astype(np.int8))
    for query in rng.integers(-127, 128, (100, 1, 12)).astype(np.int8):
        ids, distances = scene.search_codes(query, k=1)
        limit = int(distances[0, 0])
        assert scene.search_codes(query, k=1, max_distance=limit)[0] == ids
        assert scene.search_codes(query, k=1, max_distance=limit - 1)[0] == -1
    for limit in (2**31 - 1, 2**40):
        assert (scene.search_codes(query, k=1, max_distance=limit)[0] == ids).all()
    with pytest.raises(ValueError, match="max_distance must not be negative"):
        scene.search_codes(query, max_distance=-1)
    with pytest.raises(TypeError):
        scene.search_codes(query, max_distance=1.5)  # type: ignore[arg-type]


def test_ties_go_to_the_smaller_id(encoder: pm.Encoder) -> None:
    scene = pm.PrototypeMap(encoder)
    descriptors = np.repeat(random_descriptors(1), 40, axis=0)
    scene.add(np.arange(40)[::-1], descriptors)
    ids, distances = scene.search(descriptors[:1], k=5)
    np.testing.assert_array_equal(ids, [[0, 1, 2, 3, 4]])
    np.testing.assert_array_equal(distances, np.zeros((1, 5)))


def test_search_across_chunks(encoder: pm.Encoder) -> None:
    """A map larger than the search's chunks."""
    rng = np.random.default_rng(0)
    scene = pm.PrototypeMap(encoder)
    codes = rng.integers(-127, 128, (3000, 12)).astype(np.int8)
    scene.add_codes(np.arange(3000), codes)
    queries = rng.integers(-127, 128, (50, 12)).astype(np.int8)
    squared = ((queries[:, None].astype(np.int64) - codes[None]) ** 2).sum(-1)
    np.testing.assert_array_equal(
        scene.search_codes(queries, k=3)[0], np.argsort(squared, axis=1, kind="stable")[:, :3]
    )


def test_empty_map_has_no_neighbours(encoder: pm.Encoder) -> None:
    scene = pm.PrototypeMap(encoder)
    ids, distances = scene.search(random_descriptors(3), k=2)
    np.testing.assert_array_equal(ids, np.full((3, 2), -1))
    assert (distances == NO_DISTANCE).all()
    assert len(scene) == 0
    scene.add(np.zeros(0, np.int64), np.zeros((0, 8), np.uint8))
    assert scene.search(np.zeros((0, 8), np.uint8))[0].shape == (0, 2)


def test_positions(encoder: pm.Encoder) -> None:
    scene = pm.PrototypeMap(encoder)
    scene.add([5, 6, 7], random_descriptors(3))
    assert np.isnan(scene.positions([5])).all()
    scene.set_positions([7, 5], np.array([[1e6, 2, 3], [4, 5, 6]]))
    np.testing.assert_array_equal(scene.positions([5, 7]), [[4, 5, 6], [1e6, 2, 3]])
    scene.merge_landmarks(6, 5)
    np.testing.assert_array_equal(scene.positions([6]), [[4, 5, 6]])
    scene.remove([6])
    np.testing.assert_array_equal(scene.positions([7]), [[1e6, 2, 3]])
    with pytest.raises(ValueError, match="position of landmark 7 is not finite"):
        scene.set_positions([7], np.array([[1, np.inf, 2]]))
    with pytest.raises(TypeError, match=r"positions: a \(n, 3\) float64"):
        scene.set_positions([7], [[1, 2]])


def test_wrong_calls_change_nothing(encoder: pm.Encoder, tmp_path: Path) -> None:
    scene = pm.PrototypeMap(encoder)
    descriptors = random_descriptors(6)
    scene.add([0, 0, 1, 2, 2, 2], descriptors)
    before = file_bytes(scene, tmp_path)
    calls: list[tuple[type[Exception], str, Any]] = [
        (KeyError, "landmark 9 is not in the map", lambda: scene.subtract([0, 9], descriptors[:2])),
        (KeyError, "landmark 9 is not in the map", lambda: scene.merge_landmarks([0], [9])),
        (KeyError, "landmark 9 is not in the map", lambda: scene.remove([0, 9])),
        (KeyError, "landmark 9 is not in the map", lambda: scene.counts([9])),
        (KeyError, "landmark -1 is not in the map", lambda: scene.prototypes([0, -1])),
        (KeyError, "landmark 9 is not", lambda: scene.set_positions([0, 9], np.zeros((2, 3)))),
        (ValueError, "landmark id -1 is negative", lambda: scene.add([0, -1], descriptors[:2])),
        (ValueError, "2 landmark ids for 3 desc", lambda: scene.add([0, 1], descriptors[:3])),
        (ValueError, "has 1 observations, 2", lambda: scene.subtract([1, 1], descriptors[:2])),
        (ValueError, "were never added", lambda: scene.subtract([1], descriptors[:1])),
        (ValueError, "merged into itself", lambda: scene.merge_landmarks([0], [0])),
        (ValueError, "earlier in the same call", lambda: scene.merge_landmarks([0, 2], [1, 1])),
        (ValueError, "cannot be merged into itself", lambda: scene.merge_map(scene)),
        (ValueError, "7 bytes, encoder", lambda: scene.add([0], np.zeros((1, 7), np.uint8))),
        (TypeError, "landmark ids", lambda: scene.add([0.5], descriptors[:1])),
    ]
    for error, message, call in calls:
        with pytest.raises(error, match=message):
            call()
        assert file_bytes(scene, tmp_path) == before


def test_maps_of_different_encoders_do_not_merge(
    encoder: pm.Encoder, layers: list[dict[str, Any]]
) -> None:
    other = [dict(layer) for layer in layers]
    other[0] = {**other[0], "bias": other[0]["bias"] + 1}
    stranger = pm.Encoder(other, [5, 12], name="tiny", descriptor="test", scale=0.02)
    scene = pm.PrototypeMap(encoder)
    with pytest.raises(ValueError, match="different encoders"):
        scene.merge_map(pm.PrototypeMap(stranger))
    with pytest.raises(ValueError, match="different encoders or dimensions"):
        scene.merge_map(pm.PrototypeMap(encoder, dim=5))
    with pytest.raises(ValueError, match="has no codes of 6 dimensions"):
        pm.PrototypeMap(encoder, dim=6)


def test_ids_of_all_sizes(encoder: pm.Encoder) -> None:
    """The index stays whole after many insertions and removals."""
    rng = np.random.default_rng(1)
    scene = pm.PrototypeMap(encoder)
    there: set[int] = set()
    universe = np.concatenate([np.arange(300), 2**62 + 4096 * np.arange(300)])
    code = np.ones((1, 12), np.int8)
    for _ in range(20):
        new = rng.choice(universe, 200, replace=False)
        scene.add_codes(new, np.repeat(code, 200, axis=0))
        there |= set(new.tolist())
        gone = rng.choice(sorted(there), len(there) // 2, replace=False)
        scene.remove(gone)
        there -= set(gone.tolist())
        np.testing.assert_array_equal(scene.ids, sorted(there))
        assert scene.counts(sorted(there)).min() >= 1
