"""Codebooks that training learns for sealed maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import protomark as pm
from conftest import random_descriptors, random_layers
from protomark.training.codebooks import tuned_prototypes, with_codebooks, words_of
from protomark.training.sampling import Views


def views(landmarks: int, seed: int = 0) -> Views:
    """Four observations of each landmark."""
    rng = np.random.default_rng(seed)
    descriptors = np.repeat(random_descriptors(landmarks, 64, seed), 4, axis=0)
    noise = np.packbits(rng.random((len(descriptors), 64)) < 0.1, axis=1)
    return Views("s", descriptors ^ noise, np.arange(0, len(descriptors) + 1, 4))


def error(words: np.ndarray, points: np.ndarray) -> float:
    distances = ((points[:, None].astype(float) - words[None].astype(float)) ** 2).sum(2)
    return float(distances.min(1).mean())


def test_words_fit_points_better_than_points_themselves() -> None:
    rng = np.random.default_rng(0)
    points = np.clip(rng.normal(0, 40, (5000, 2)), -127, 127).astype(np.int8)
    words = words_of(points)
    assert words.shape == (256, 2)
    assert words.dtype == np.int8
    assert error(words, points) < 0.7 * error(points[:256], points)


def test_few_points_are_words() -> None:
    points = np.array([[1, 2], [1, 2], [-127, 127], [0, 0]], np.int8)
    assert error(words_of(points), points) == 0


def test_codebooks_shrink_prototypes_with_less_error_than_even_levels(tmp_path: Path) -> None:
    coder = pm.Encoder(
        random_layers([64, 40, 24]), [4, 12, 16, 24], name="t", descriptor="test", scale=0.02
    )
    learned = with_codebooks(coder, [views(2000, 1), views(1000, 2)])
    assert learned.identity == coder.identity
    assert [book.shape for book in learned.codebooks] == [(12, 256, 2), (8, 256, 3)]
    scene = pm.PrototypeMap(learned)
    seen = views(500, 3)
    scene.add(np.repeat(np.arange(500), 4), seen.descriptors)
    exact = scene.seal(tmp_path / "a.pmk").prototypes(scene.ids)
    for size, dim, even in ((12, 24, 8), (8, 24, 20)):
        sealed = scene.seal(tmp_path / "b.pmk", bytes_per_landmark=size, tune=False)
        assert sealed.dim == dim
        found = sealed.prototypes(scene.ids)
        # 16 even levels of two numbers, or 6 of three, take a byte, too.
        levels = np.rint((exact[:, :dim] + 127) / (2 * even)) * 2 * even - 127
        assert ((found - exact[:, :dim]) ** 2).mean() < ((levels - exact[:, :dim]) ** 2).mean()


def test_prototypes_are_of_landmarks(tmp_path: Path) -> None:
    coder = pm.Encoder(random_layers([64, 40, 8]), [8], name="t", descriptor="test", scale=0.02)
    found = tuned_prototypes(coder, views(50))
    assert found.shape == (50, 8)
    codes = coder.encode(views(50).descriptors).reshape(50, 4, 8).astype(float)
    assert abs(found - codes.mean(1)).mean() < abs(found[::-1] - codes.mean(1)).mean()
