"""`protomark map` on photos whose names say nothing about where they were taken."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping_scene import interrupted_at, walk, write_images
from protomark.geometry.colmap import pycolmap
from protomark.geometry.pose import camera_centers
from protomark.mapping.options import MappingOptions
from protomark.mapping.request import MapRequest
from protomark.mapping.session import make_map
from test_mapping import trajectory_rmse

# Frames that are far apart see different parts of the walls.
POSES = walk(16, step=0.2)
ORDER = np.random.default_rng(1).permutation(len(POSES))


def mapped(folder: Path, poses: NDArray[np.float64]) -> tuple[MapRequest, float, list[str]]:
    """Map images of these poses; returns also the trajectory error, and the notes."""
    images = write_images(folder / "images", poses)
    options = MappingOptions(descriptor="orb", max_keypoints=500)
    request = MapRequest(images, folder / "scene", options, camera="PINHOLE:300,300,160,120")
    notes: list[str] = []
    figures = make_map(request, note=notes.append)
    assert figures["registered"] == len(poses)
    found = pycolmap.Reconstruction(str(request.output / "sparse")).images.values()
    true = camera_centers(np.array([poses[int(image.name[3:-4]) - 1] for image in found]))
    centers = np.array([image.projection_center() for image in found])
    return request, trajectory_rmse(centers, true), notes


def test_photos_in_no_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    _, error, notes = mapped(tmp_path / "ordered", POSES)
    assert not any("order" in note for note in notes)
    request, shuffled_error, notes = mapped(tmp_path / "shuffled", POSES[ORDER])
    assert any("the photos are in no order" in note for note in notes)
    assert shuffled_error < 1.5 * error + 0.01

    # A stopped map goes on in the same order.
    other = replace(request, output=tmp_path / "other")
    interrupted_at(9, other, monkeypatch)
    make_map(replace(other, resume=True))
    maps = [(one.output / "scene.pmk").read_bytes() for one in (request, other)]
    assert maps[0] == maps[1]
