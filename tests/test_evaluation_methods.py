"""Every baseline, compared with a plain implementation of its definition."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import protomark as pm
from conftest import random_codebooks, random_descriptors, random_layers
from evaluation_scene import observations
from protomark.baselines.binary import (
    DescriptorMap,
    bitwise_and,
    first_seen,
    majority,
    medoid,
    random_sample,
    unaggregated,
)
from protomark.baselines.linear import (
    RIDGE,
    linear_discriminants,
    principal_components,
    projected_mean,
    real_mean,
)
from protomark.baselines.support import Moments, Support
from protomark.evaluation.methods import choose_methods, method_choices, prototype_map
from protomark.features.descriptors import unpack_bits

Observations = tuple[NDArray[np.int64], NDArray[np.uint8]]


def groups(data: Observations) -> dict[int, NDArray[np.uint8]]:
    """Landmark -> its descriptors in their order."""
    landmarks, descriptors = data
    return {i: descriptors[landmarks == i] for i in np.unique(landmarks).tolist()}


def as_dict(built: DescriptorMap) -> dict[int, list[int]]:
    """Landmark -> its only descriptor."""
    assert len(set(built.landmarks.tolist())) == len(built.landmarks)
    return dict(zip(built.landmarks.tolist(), built.descriptors.tolist(), strict=True))


def hamming(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> int:
    return sum(int(x ^ y).bit_count() for x, y in zip(a.tolist(), b.tolist(), strict=True))


@given(observations(), st.integers(1, 40))
def test_support_groups_and_counts(data: Observations, rows: int) -> None:
    support = Support(*data)
    for i, (landmark, descriptors) in enumerate(groups(data).items()):
        start, count = support.starts[i], support.counts[i]
        assert support.ids[i] == landmark
        assert np.array_equal(support.descriptors[start : start + count], descriptors)
        assert np.array_equal(support.sums[i], unpack_bits(descriptors).astype(int).sum(axis=0))
    pieces = list(support.pieces(rows))
    assert [first for first, _ in pieces] == [0, *[last for _, last in pieces[:-1]]]
    assert pieces[-1][1] == len(support.ids)


@given(observations())
def test_majority(data: Observations) -> None:
    for landmark, descriptor in as_dict(majority(Support(*data))).items():
        own = groups(data)[landmark]
        for byte in range(own.shape[1]):
            for bit in range(8):
                ones = sum(int(d) >> bit & 1 for d in own[:, byte])
                assert descriptor[byte] >> bit & 1 == (2 * ones >= len(own))


@given(observations())
def test_bitwise_and(data: Observations) -> None:
    expected = {
        landmark: np.bitwise_and.reduce(own, axis=0).tolist()
        for landmark, own in groups(data).items()
    }
    assert as_dict(bitwise_and(Support(*data))) == expected


@given(observations())
def test_medoid_is_that_of_orb_slam(data: Observations) -> None:
    """`MapPoint::ComputeDistinctiveDescriptors`, line by line."""
    for landmark, descriptor in as_dict(medoid(Support(*data))).items():
        own = groups(data)[landmark]
        best_median, best = 2**31 - 1, 0
        for i in range(len(own)):
            distances = sorted(hamming(own[i], own[j]) for j in range(len(own)))
            median = distances[int(0.5 * (len(own) - 1))]
            if median < best_median:
                best_median, best = median, i
        assert descriptor == own[best].tolist()


def test_medoid_of_many_observations() -> None:
    """Several batches of groups, and groups of hundreds of descriptors."""
    rng = np.random.default_rng(0)
    counts = np.concatenate([np.full(3000, 2), [300, 300]])
    landmarks = np.repeat(np.arange(len(counts)), counts)
    descriptors = rng.integers(0, 256, (len(landmarks), 64), dtype=np.uint8)
    kept = as_dict(medoid(Support(landmarks, descriptors)))
    assert all(kept[i] == descriptors[2 * i].tolist() for i in range(3000))
    for i in (3000, 3001):
        own = unpack_bits(descriptors[landmarks == i]).astype(int)
        distances = np.sort([(own != one).sum(axis=1) for one in own], axis=1)
        best = np.argmin(distances[:, 149])
        assert kept[i] == descriptors[landmarks == i][best].tolist()


@given(observations(), st.integers(0, 3))
def test_single_descriptors_are_the_landmarks_own(data: Observations, seed: int) -> None:
    own = groups(data)
    support = Support(*data, seed=seed)
    assert as_dict(first_seen(support)) == {i: own[i][0].tolist() for i in own}
    drawn = as_dict(random_sample(support))
    assert drawn.keys() == own.keys()
    assert all(drawn[i] in own[i].tolist() for i in own)


def test_random_sample_draws_every_observation() -> None:
    descriptors = random_descriptors(4)
    drawn = {
        tuple(random_sample(Support(np.zeros(4, np.int64), descriptors, seed)).descriptors[0])
        for seed in range(60)
    }
    assert drawn == {tuple(d) for d in descriptors}


@given(observations(), st.integers(0, 2**32 - 1))
def test_unaggregated_finds_distinct_landmarks(data: Observations, seed: int) -> None:
    queries = random_descriptors(5, bits=16, seed=seed)
    own = groups(data)
    ids, distances = unaggregated(Support(*data)).match(queries)
    for query, row, far in zip(queries, ids.tolist(), distances.tolist(), strict=True):
        every = [(float(min(hamming(query, d) for d in own[i])), i) for i in own]
        expected = sorted(every)[:2]
        expected += [(float("inf"), -1)] * (2 - len(expected))
        assert [(d, i) for d, i in zip(far, row, strict=True)] == expected


@given(observations(), st.integers(0, 2**32 - 1), st.integers(1, 2))
def test_real_mean_finds_the_nearest_means(data: Observations, seed: int, threads: int) -> None:
    queries = random_descriptors(5, bits=16, seed=seed)
    own = {i: unpack_bits(d).mean(axis=0, dtype=np.float64) for i, d in groups(data).items()}
    ids, distances = real_mean(Support(*data)).match(queries, threads=threads)
    for query, row, far in zip(unpack_bits(queries).astype(float), ids, distances, strict=True):
        every = {i: float(np.linalg.norm(query - own[i])) for i in own}
        expected = sorted(every.values())[:2]
        assert far[: len(expected)] == pytest.approx(expected, abs=2e-3)
        # Rounding may swap landmarks that are as good as equally far, never others.
        for i, d in zip(row.tolist(), expected, strict=False):
            assert every[i] == pytest.approx(d, abs=2e-3)
        assert len(set(row[: len(expected)].tolist())) == len(expected)
        assert (row[len(expected) :] == -1).all()
        assert np.isinf(far[len(expected) :]).all()


def test_equal_vectors_give_the_smaller_id_across_blocks() -> None:
    """More landmarks than one block of the search holds, all with the same descriptor."""
    ids = np.arange(5000)
    support = Support(np.repeat(ids, 2), np.tile(random_descriptors(1), (10_000, 1)))
    for method in (real_mean(support), unaggregated(support)):
        found, _ = method.match(random_descriptors(3, seed=1))
        assert found.tolist() == [[0, 1]] * 3


def test_bytes_per_landmark(encoder: pm.Encoder) -> None:
    counts = [2, 3, 7]
    support = Support(np.repeat([4, 5, 9], counts), random_descriptors(12))
    built = {c.name: c.build(support).bytes_per_landmark for c in method_choices([encoder])}
    assert built["unaggregated"] == 12 / 3 * 8 + 1
    assert {built[n] for n in ("random", "first", "majority", "and", "medoid")} == {8}
    assert built["mean"] == 64 * 4 + 1
    for dim in (8, 16, 32):
        assert built[f"pca-{dim}"] == built[f"discriminant-{dim}"] == dim + 1
        assert built[f"pca-{dim}-float"] == 4 * dim + 1
    # A prototype fills whole words of 4 bytes.
    assert (built["protomark-5"], built["protomark-12"]) == (8 + 1, 12 + 1)


def structured(seed: int = 0, landmarks: int = 300, count: int = 6) -> Observations:
    """Descriptors with correlated bits, of which some flip more often than others."""
    rng = np.random.default_rng(seed)
    latent = rng.normal(size=(landmarks, 10)) @ rng.normal(size=(10, 64))
    noise = rng.normal(size=(landmarks * count, 64)) * rng.uniform(0.2, 3, 64)
    bits = np.repeat(latent, count, axis=0) + noise > 0
    return np.repeat(np.arange(landmarks), count), np.packbits(bits, axis=1, bitorder="little")


def test_moments_are_the_covariances() -> None:
    landmarks, descriptors = structured()
    moments = Support(landmarks, descriptors).moments
    bits = unpack_bits(descriptors).astype(float)
    assert moments.mean == pytest.approx(bits.mean(axis=0))
    assert moments.total == pytest.approx(np.cov(bits.T, bias=True), abs=1e-6)
    pairs = [
        bits[i] - bits[j]
        for landmark in range(300)
        for i, j in combinations(np.flatnonzero(landmarks == landmark), 2)
    ]
    # All landmarks have equally many observations, so all pairs count alike.
    within = np.array(pairs).T @ np.array(pairs) / len(pairs) / 2
    assert moments.within == pytest.approx(within, abs=1e-6)


def test_principal_components_against_singular_vectors() -> None:
    support = Support(*structured())
    matrix = principal_components(support.moments).truncated(5).matrix
    bits = unpack_bits(support.descriptors).astype(float)
    _, _, expected = np.linalg.svd(bits - bits.mean(axis=0), full_matrices=False)
    assert np.abs(np.diag(expected[:5] @ matrix)) == pytest.approx(np.ones(5), abs=1e-4)
    assert matrix.T @ matrix == pytest.approx(np.eye(5), abs=1e-5)


def test_linear_discriminants_whiten_matches_and_separate_the_rest() -> None:
    moments = Support(*structured()).moments
    matrix = linear_discriminants(moments).truncated(8).matrix.astype(float)
    ridge = RIDGE * np.trace(moments.within) / 64 * np.eye(64)
    assert matrix.T @ (moments.within + ridge) @ matrix == pytest.approx(np.eye(8), abs=1e-3)
    separated = matrix.T @ moments.total @ matrix
    ratios = np.diag(separated)
    assert separated == pytest.approx(np.diag(ratios), abs=1e-2)
    # The generalised eigenvalues, from the definition.
    values = np.linalg.eigvals(np.linalg.solve(moments.within + ridge, moments.total)).real
    assert ratios == pytest.approx(np.sort(values)[::-1][:8], rel=1e-3)


@pytest.mark.parametrize("learned", [principal_components, linear_discriminants])
def test_projected_means(learned: object) -> None:
    assert callable(learned)
    support = Support(*structured())
    projection = learned(support.moments).truncated(16)
    queries = random_descriptors(20)
    centred = unpack_bits(queries).astype(float) - support.moments.mean
    means = (support.means - support.moments.mean) @ projection.matrix.astype(float)
    every = np.linalg.norm((centred @ projection.matrix)[:, None] - means[None], axis=2)
    exact = projected_mean(support, projection, rounded=False)
    ids, distances = exact.match(queries)
    assert distances == pytest.approx(np.sort(every, axis=1)[:, :2], rel=1e-3, abs=1e-3)
    assert np.array_equal(ids, np.argsort(every, axis=1)[:, :2])
    # int8 moves each of the 16 numbers by half a step at most.
    step = np.abs(means).max() / 127
    _, rounded = projected_mean(support, projection, rounded=True).match(queries)
    assert np.abs(rounded - distances).max() <= 16**0.5 * step / 2 + 1e-3


def assert_same_matches(
    built: Any, scene: pm.PrototypeMap | pm.SealedMap, queries: NDArray[np.uint8]
) -> None:
    """Methods return distances, the core returns squared distances."""
    ids, distances = built.match(queries)
    expected_ids, squared = scene.search(queries)
    assert np.array_equal(ids, expected_ids)
    assert np.array_equal(distances, np.sqrt(squared.astype(np.float32)))


def test_prototypes_are_the_cores_map(encoder: pm.Encoder) -> None:
    landmarks, descriptors = structured()
    scene = pm.PrototypeMap(encoder, dim=5)
    scene.add(landmarks, descriptors)
    queries = random_descriptors(30)
    built = prototype_map(Support(landmarks, descriptors), encoder, 5)
    assert_same_matches(built, scene, queries)


def test_sealed_maps_of_a_size(tmp_path: Path) -> None:
    coder = pm.Encoder(
        random_layers([64, 40, 32]),
        [8, 16, 32],
        name="w",
        descriptor="test",
        scale=0.02,
        codebooks=random_codebooks((16, 2)),
    )
    landmarks, descriptors = structured()
    listed = method_choices([coder])
    names = [c.name for c in choose_methods(listed, None)]
    assert names[-5:] == ["sealed-9", "sealed-17", "sealed-25", "sealed-33", "sealed-65"]
    scene = pm.PrototypeMap(coder, appearance_bits=5)
    scene.add(landmarks, descriptors)
    queries = random_descriptors(30)
    answers = []
    for family, observed, tune in (
        ("sealed", (landmarks, descriptors), True),
        ("appearances", (None, None), True),
        ("untuned", (None, None), False),
    ):
        chosen = choose_methods(listed, [f"protomark-{family}"])
        for choice, size in zip(chosen, (9, 17, 25, 33, 65), strict=True):
            built = choice.build(Support(landmarks, descriptors))
            sealed = scene.seal(tmp_path / "s.pmk", *observed, bytes_per_landmark=size, tune=tune)
            # What the file really holds, but for the last block of 16 prototypes.
            sizes = dict(pm.file_sections(tmp_path / "s.pmk"))
            held = sum(sizes.get(n, 0) for n in ("counts", "rows", "protos")) / len(scene)
            assert held - 16 * 32 / len(scene) <= built.bytes_per_landmark <= min(held, size)
            assert_same_matches(built, sealed, queries)
            if size == 17:
                answers.append(sealed.search(queries)[1])
    assert not np.array_equal(answers[0], answers[1])
    assert not np.array_equal(answers[1], answers[2])
    assert "sealed-17@w" in [c.name for c in method_choices([coder, coder])]


def test_choosing_methods(encoder: pm.Encoder) -> None:
    listed = method_choices([encoder])
    names = [c.name for c in choose_methods(listed, None)]
    assert names[0] == "unaggregated"
    assert [n for n in names if n.startswith("protomark")] == ["protomark-5", "protomark-12"]
    assert not any(name.endswith("float") for name in names)
    # In the order of the table, whatever the order they are asked for.
    some = [c.name for c in choose_methods(listed, ["pca", "medoid", "pca-8-float"])]
    assert some == ["medoid", "pca-8", "pca-16", "pca-32", "pca-64", "pca-8-float"]
    with pytest.raises(ValueError, match=r"no method 'median'.*medoid"):
        choose_methods(listed, ["median"])


def test_several_encoders_are_told_apart(encoder: pm.Encoder) -> None:
    names = [c.name for c in method_choices([encoder, encoder])]
    assert "protomark-12@tiny" in names
    assert "protomark-12" not in names


def test_moments_of_a_part_are_close_to_those_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    data = structured(landmarks=3000)
    every = Support(*data).moments
    monkeypatch.setattr(Moments, "MAX_ROWS", 6000)
    part = Support(*data).moments
    assert np.abs(part.total - every.total).max() < 0.02
    assert not np.array_equal(part.total, every.total)


def test_an_empty_support_is_refused() -> None:
    with pytest.raises(ValueError, match="no observations"):
        Support(np.empty(0, np.int64), np.empty((0, 8), np.uint8))
