"""Selection of keypoints that are not too close to each other."""

from __future__ import annotations

import numpy as np
import pytest

from protomark.features.extractor import MIN_DISTANCE, _apart


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
