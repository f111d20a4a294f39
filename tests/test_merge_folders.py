"""Folders of `protomark map` that are merged: frames, cameras and observations come along."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

import protomark as pm
from conftest import protomark
from mapping_scene import walk, write_images
from protomark.files import STATE
from protomark.geometry.colmap import find_model, read_model
from protomark.geometry.pose import camera_centers
from protomark.geometry.pose_files import read_poses
from protomark.geometry.similarity import fit_similarity
from protomark.mapping import merging_maps
from protomark.mapping.merging_maps import merge_folders
from protomark.mapping.request import MapRequest
from protomark.mapping.session import make_map
from protomark.mapping.state import load_state
from test_mapping import CAMERA, SETTINGS
from test_mapping_continue import contents

FRAMES = 15
POSES = walk(FRAMES)


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """Maps of the walk's beginning, of its end, and of another room."""
    folder = tmp_path_factory.mktemp("maps")
    scenes = []
    for name, frames, seed in (
        ("hall", range(9), 0),
        ("room", range(6, FRAMES), 0),
        ("else", range(6), 100),
    ):
        images = write_images(folder / f"{name}-images", POSES[list(frames)], seed=seed)
        make_map(MapRequest(images, folder / name, SETTINGS, camera=CAMERA))
        scenes.append(folder / name)
    return scenes[0], scenes[1], scenes[2]


def test_frames_come_along(maps: tuple[Path, Path, Path], tmp_path: Path) -> None:
    output = tmp_path / "merged"
    before = [contents(path) for path in maps]
    done = protomark("merge", *maps[:2], "-o", output)
    assert done.returncode == 0, done.stderr
    assert [contents(path) for path in maps] == before
    assert set(contents(output)) == set(before[0])

    # All stations hold all frames, in the world of the first map.
    model = read_model(find_model(output))
    names = [f"img{i}.png" for i in range(1, 10)]
    assert model.names == [*names, *(f"room/{name}" for name in names)]
    true = camera_centers(POSES[[*range(9), *range(6, FRAMES)]])
    motion = fit_similarity(model.centers, true)
    assert np.linalg.norm(motion(model.centers) - true, axis=1).max() < 0.02
    assert len(read_poses(output / "trajectory.txt").times) == 18
    first = read_model(find_model(maps[0])).centers
    np.testing.assert_allclose(model.centers[:9], first, atol=0.02)
    one, other, merged = (pm.open(path / "scene.pmk") for path in (*maps[:2], output))
    assert len(merged) < 0.9 * (len(one) + len(other))
    mapper, facts = load_state(output)
    np.testing.assert_array_equal(mapper.structure.ids, merged.ids)
    assert len(facts["inputs"]) == 2
    counts = sum(s.summary()["observations"] for s in (one, other))
    assert merged.summary()["observations"] > 0.9 * counts

    # It is a map like any other: it takes more images.
    more = write_images(tmp_path / "more", walk(FRAMES + 2)[FRAMES:])
    figures = make_map(MapRequest(more, output, SETTINGS, camera=CAMERA, extend=True))
    assert figures["registered"] == 20


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def test_folders_that_cannot_be_merged(
    maps: tuple[Path, Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output, copy, bare = (tmp_path / name for name in ("merged", "copy", "bare"))
    shutil.copytree(maps[0], copy)
    shutil.copytree(maps[1], bare)
    (bare / STATE).unlink()
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "file").write_text("mine")
    for inputs, message in (
        ([maps[0], maps[2]], "else: .*stand for other landmarks there"),
        ([maps[0], copy], "copy: its frames in .* would count twice"),
        ([maps[0], bare], "bare is no folder of a finished"),
        ([maps[0], maps[1] / "scene.pmk"], "scene.pmk is no folder of a finished"),
        ([maps[0]], "at least two maps"),
    ):
        with pytest.raises(ValueError, match=message):
            merge_folders(inputs, output)
        assert not output.exists()
    with pytest.raises(FileExistsError, match="name a new folder"):
        merge_folders(maps[:2], taken)
    monkeypatch.setattr(merging_maps, "save_state", interrupt)
    with pytest.raises(KeyboardInterrupt):
        merge_folders(maps[:2], output)
    assert not output.exists()
    assert contents(taken) == {"file": b"mine"}
