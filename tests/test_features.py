"""Keypoints that are not too close to each other, and detectors of other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from protomark.features.extractor import MIN_DISTANCE, Extractor, _apart
from protomark.features.images import read_gray


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


def test_detectors_of_other_programs() -> None:
    """Their settings decide how images are described that their maps will be searched for."""
    path = Path(__file__).parent / "data" / "orbslam3" / "5.500000.jpg"
    image = read_gray(path)
    usual = Extractor("orb", 500)(image)
    same = Extractor("orb", 500, detector={"name": "ORB-SLAM", "levels": 8, "scale_factor": 1.2})
    assert np.array_equal(same(image).descriptors, usual.descriptors)
    coarse = Extractor("orb", 500, detector={"levels": 3.0, "scale_factor": 2})(image)
    assert set(np.unique(coarse.octaves)) == {0, 1, 2}
    np.testing.assert_allclose(coarse.sizes, 31 * 2.0**coarse.octaves)
    corners = Extractor("orb", 500, detector={"name": "GFTT/ORB", "block_size": 5.0})(image)
    assert len(corners) > 100
    assert (set(corners.angles), set(corners.sizes)) == ({-1}, {5})
    for wrong in ({"levels": 0}, {"levels": "8"}, {"scale_factor": float("nan")}):
        with pytest.raises(ValueError, match="of a detector is from"):
            Extractor("orb", detector=wrong)
