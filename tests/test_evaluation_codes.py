"""Codes of the mean of bits, compared with plain implementations of their definitions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from conftest import random_descriptors
from protomark.baselines import hashing, quantization
from protomark.baselines.hashing import SignMap, iterative_quantization, random_hyperplanes
from protomark.baselines.linear import principal_components, real_mean
from protomark.baselines.quantization import k_means, nearest_words, product_quantized_mean
from protomark.baselines.support import Support
from protomark.evaluation.methods import choose_methods, method_choices
from protomark.features.descriptors import unpack_bits


def support_of(landmarks: int, seed: int = 0) -> Support:
    """Landmarks of three observations each, with correlated bits."""
    rng = np.random.default_rng(seed)
    latent = rng.normal(size=(landmarks, 10)) @ rng.normal(size=(10, 64))
    bits = np.repeat(latent, 3, axis=0) + rng.normal(size=(3 * landmarks, 64)) > 0
    ids = np.repeat(7 * np.arange(landmarks), 3)
    return Support(ids, np.packbits(bits, axis=1, bitorder="little"), seed)


def quantization_error(values: NDArray[np.float32], words: NDArray[np.float32]) -> float:
    distances = ((values[:, None].astype(float) - words[None]) ** 2).sum(axis=2)
    return float(distances.min(axis=1).mean())


def test_nearest_words_against_all_distances() -> None:
    rng = np.random.default_rng(0)
    # More values than one piece holds, of few distinct numbers: equal distances are common.
    values = rng.integers(0, 5, (2500, 3)).astype(np.float32)
    words = np.concatenate([values[:40], values[:40]])
    distances = ((values[:, None] - words[None]) ** 2).sum(axis=2)
    assert np.array_equal(nearest_words(values, words), distances.argmin(axis=1))


def test_k_means_is_lloyds() -> None:
    # Of normal numbers, as means of few bits are often equally far from two words.
    values = np.random.default_rng(0).normal(size=(900, 6)).astype(np.float32)
    words = np.unique(values, axis=0)[np.random.default_rng(3).permutation(900)[:20]].astype(float)
    for _ in range(quantization.PASSES):
        nearest = ((values[:, None] - words[None]) ** 2).sum(axis=2).argmin(axis=1)
        words = np.array([values[nearest == i].mean(axis=0) for i in range(20)])
    assert k_means(values, 20, np.random.default_rng(3)) == pytest.approx(words, abs=1e-5)


def test_words_of_fewer_values() -> None:
    values = np.repeat(np.arange(12, dtype=np.float32), 50)[:, None]
    words = k_means(values, 16, np.random.default_rng(0))
    assert len(words) == 16
    assert set(words.ravel()) == set(values.ravel())


def test_as_many_words_as_landmarks_are_the_means() -> None:
    support, queries = support_of(200), random_descriptors(30)
    expected = real_mean(support).match(queries)
    found = product_quantized_mean(support, 4).match(queries)
    assert found[1] == pytest.approx(expected[1], abs=1e-4)


def test_product_quantisation_against_its_definition(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quantization, "WORDS", 16)
    support, queries = support_of(700, seed=5), random_descriptors(40)
    rng = np.random.default_rng(5)
    bits = unpack_bits(queries).astype(float)
    squared = np.zeros((40, 700))
    # 64 bits in 5 parts: four of 13, and one of 12.
    for start, end in ((0, 13), (13, 26), (26, 39), (39, 52), (52, 64)):
        means = support.means[:, start:end]
        words = k_means(means, 16, rng).astype(float)
        code = ((means[:, None] - words[None]) ** 2).sum(axis=2).argmin(axis=1)
        table = ((bits[:, None, start:end] - words[None]) ** 2).sum(axis=2)
        squared += table[:, code]
    built = product_quantized_mean(support, 5)
    ids, distances = built.match(queries, threads=2)
    assert built.bytes_per_landmark == 6
    assert distances == pytest.approx(np.sqrt(np.sort(squared, axis=1)[:, :2]), abs=1e-4)
    # Landmarks with equal words are equally far away; rounding must not swap others.
    own = squared[np.arange(40)[:, None], ids // 7]
    assert np.sqrt(own) == pytest.approx(distances, abs=1e-4)
    assert (ids[:, 0] != ids[:, 1]).all()


def test_words_are_as_good_as_those_of_faiss() -> None:
    faiss = pytest.importorskip("faiss")
    means = support_of(8000).means
    theirs = faiss.ProductQuantizer(64, 8, 8)
    theirs.train(means)
    error = ((theirs.decode(theirs.compute_codes(means)) - means) ** 2).sum(axis=1).mean()
    rng = np.random.default_rng(0)
    own = sum(
        quantization_error(means[:, i : i + 8], k_means(means[:, i : i + 8], 256, rng))
        for i in range(0, 64, 8)
    )
    assert own == pytest.approx(error, rel=0.02)


def plain_matches(
    built: SignMap, support: Support, queries: NDArray[np.uint8]
) -> tuple[list[list[int]], list[list[int]]]:
    """The two landmarks whose signs differ least from the query's, ties to the smaller id."""
    mean, matrix = built.projection.mean, built.projection.matrix
    codes = (support.means - mean) @ matrix >= 0
    asked = (unpack_bits(queries).astype(np.float32) - mean) @ matrix >= 0
    differing = (asked[:, None] != codes[None]).sum(axis=2)
    nearest = np.argsort(differing, axis=1, kind="stable")[:, :2]
    return support.ids[nearest].tolist(), np.take_along_axis(differing, nearest, 1).tolist()


@pytest.mark.parametrize("build", [random_hyperplanes, iterative_quantization])
@pytest.mark.parametrize("size", [1, 3, 8])
def test_signs_are_searched_by_hamming_distance(
    build: Callable[[Support, int], SignMap], size: int
) -> None:
    support, queries = support_of(300), random_descriptors(40)
    built = build(support, size)
    assert built.bytes_per_landmark == size
    ids, distances = built.match(queries, threads=2)
    assert (ids.tolist(), distances.tolist()) == plain_matches(built, support, queries)


def test_hyperplanes_are_random_and_pass_through_the_mean() -> None:
    support = support_of(300)
    projection = random_hyperplanes(support, 64).projection
    bits = unpack_bits(support.descriptors).astype(float)
    assert projection.mean == pytest.approx(bits.mean(axis=0), abs=1e-6)
    # 512 normal numbers a bit.
    assert np.cov(projection.matrix) == pytest.approx(np.eye(64), abs=0.3)
    again = random_hyperplanes(support, 64).projection.matrix
    assert np.array_equal(projection.matrix, again)
    other = random_hyperplanes(support_of(300, seed=1), 64).projection.matrix
    assert not np.array_equal(projection.matrix, other)


def test_iterative_quantisation_rotates_principal_components_to_their_signs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    support = support_of(2000)
    components = principal_components(support.moments).truncated(16)
    matrix = iterative_quantization(support, 2).projection.matrix
    rotation = components.matrix.T @ matrix
    assert rotation.T @ rotation == pytest.approx(np.eye(16), abs=1e-4)
    assert components.matrix @ rotation == pytest.approx(matrix, abs=1e-4)

    values = (support.means - components.mean) @ components.matrix

    def error(rotation: NDArray[np.float32]) -> float:
        rotated = values @ rotation
        return float(((rotated - np.sign(rotated)) ** 2).sum(axis=1).mean())

    turned, _ = np.linalg.qr(np.random.default_rng(1).standard_normal((16, 16)))
    assert error(rotation) < min(error(np.eye(16, dtype=np.float32)), error(turned))
    # It has settled: as many passes again bring hardly anything.
    monkeypatch.setattr(hashing, "PASSES", 2 * hashing.PASSES)
    longer = components.matrix.T @ iterative_quantization(support, 2).projection.matrix
    assert error(longer) <= error(rotation) + 1e-4
    assert error(longer) == pytest.approx(error(rotation), rel=0.01)


def test_sizes_in_bytes() -> None:
    names = [c.name for c in choose_methods(method_choices(width=488), ["pq", "itq", "lsh"])]
    assert names[:5] == ["pq-4", "pq-8", "pq-16", "pq-32", "pq-64"]
    # 512 signs need 512 components.
    assert names[5:9] == ["itq-4", "itq-8", "itq-16", "itq-32"]
    assert names[9:] == ["lsh-4", "lsh-8", "lsh-16", "lsh-32", "lsh-64"]
    default = [c.name for c in choose_methods(method_choices(), [])]
    assert default[-3:] == ["pq-32", "itq-32", "lsh-32"]
