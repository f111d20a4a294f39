"""Keypoints and descriptors of one image."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from protomark.tracks.features import MIN_DISTANCE, Extractor, _apart


def texture(seed: int = 0, contrast: int = 255) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, contrast, (60, 80), np.uint8)
    return cv2.resize(image, (320, 240), interpolation=cv2.INTER_CUBIC)


@pytest.mark.parametrize("extent", [10.0, 60.0, 400.0])
def test_each_point_removes_all_later_ones_too_close(extent: float) -> None:
    # On a grid of halves: many points share a place, or are exactly as far apart as they must be.
    xy = np.round(2 * np.random.default_rng(1).uniform(0, extent, (500, 2))) / 2
    want: list[int] = []
    for i in range(len(xy)):
        if all(((xy[i] - xy[j]) ** 2).sum() >= MIN_DISTANCE**2 for j in want):
            want.append(i)
    assert _apart(xy, MIN_DISTANCE).tolist() == want


def test_no_points() -> None:
    assert _apart(np.zeros((0, 2)), MIN_DISTANCE).tolist() == []


@pytest.mark.parametrize(("contrast", "most"), [(255, 2000), (255, 100), (60, 300), (255, 350)])
def test_akaze_at_once_finds_what_it_finds_in_turn(contrast: int, most: int) -> None:
    image = texture(contrast=contrast)
    extractor, slow = Extractor("akaze", most), Extractor("akaze", most)
    slow._at_once = lambda image: None  # type: ignore[method-assign]
    for _ in range(2):  # the second image, after one that was as rich
        found, want = extractor(image), slow(image)
        assert len(want) > 50
        for name in ("keypoints", "sizes", "angles", "responses", "octaves", "descriptors"):
            np.testing.assert_array_equal(getattr(found, name), getattr(want, name))
