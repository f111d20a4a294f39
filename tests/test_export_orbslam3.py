"""Atlases of ORB-SLAM3 that are written anew, and what the program does with them."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conftest import protomark
from foreign_scene import check_broken_files, counts, foreign
from protomark.baselines.binary import majority
from protomark.baselines.support import Support
from protomark.exporters import export
from protomark.exporters.orbslam3 import write_orbslam3
from protomark.tracks.file import Tracks
from protomark.tracks.importers import orbslam3
from protomark.tracks.importers.orbslam3_atlas import AtlasReader
from test_import_orbslam3 import stereo, two_maps  # noqa: F401


def written(source: Path, folder: Path) -> Path:
    write_orbslam3(source, folder / "written.osa")
    return folder / "written.osa"


class _Rows(AtlasReader):
    """Remembers where descriptors lie, and the rows of keypoints that lists name."""

    def __init__(self, path: Path) -> None:
        super().__init__(path.read_bytes(), path)
        self.described: list[slice] = []
        self.lists: list[list[np.ndarray]] = []  # by keyframe: of nodes, and of cells
        self.maps = self.atlas().maps

    def _keyframe(self) -> Any:
        self.lists.append([])
        return super()._keyframe()

    def _descriptors(self) -> Any:
        descriptors = super()._descriptors()
        self.described.append(slice(self.offset - descriptors.nbytes, self.offset))
        return descriptors

    def _keypoints_of_node(self) -> Any:
        self.lists[-1].append(super()._keypoints_of_node())
        return self.lists[-1][-1]

    def skip_vectors(self, count: int) -> None:
        for _ in range(count):
            self.lists[-1].append(self.numbers("<u8"))


def assert_same_map(a: Tracks, b: Tracks) -> None:
    """All equal but for descriptors and keypoints of no landmark."""
    assert counts(a)[:3] == counts(b)[:3]
    assert (a.keyframe_names, a.cameras) == (b.keyframe_names, b.cameras)
    for name in ("cam_from_world", "landmark_ids", "landmark_positions"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), name)
    for name in ("keypoints", "sizes", "angles", "octaves", "landmark_of_keypoint"):
        first, second = (getattr(t, name)[t.observations] for t in (a, b))
        np.testing.assert_array_equal(first, second, name)
    vote = majority(Support(a.landmark_of_keypoint[a.observations], a.descriptors[a.observations]))
    owners = np.searchsorted(vote.landmarks, b.landmark_of_keypoint[b.observations])
    np.testing.assert_array_equal(b.descriptors[b.observations], vote.descriptors[owners])


def test_keypoints_of_no_landmark_are_dropped(two_maps: Path, tmp_path: Path) -> None:  # noqa: F811
    output = tmp_path / "small.osa"
    done = protomark("export", two_maps, "--to", "orbslam3", "-o", output)
    assert done.returncode == 0, done.stderr
    before, after = two_maps.stat().st_size, output.stat().st_size
    assert f"{before:,}" in done.stdout
    assert f"{after:,}" in done.stdout
    assert after < 0.6 * before
    old, new = orbslam3.read(two_maps), orbslam3.read(output)
    assert_same_map(old, new)
    assert len(new.keypoints) < 1.03 * len(new.observations)
    a, b = _Rows(two_maps), _Rows(output)
    assert len(a.lists) == len(b.lists) == len(old.keyframe_names)
    frames = [[k for one in reader.maps for k in one.keyframes] for reader in (a, b)]
    for k, new_k, lists, new_lists in zip(*frames, a.lists, b.lists, strict=True):
        rows = np.flatnonzero(np.isin(k.keypoints, new_k.keypoints))
        for name in ("keypoints", "undistorted", "points"):
            assert np.array_equal(getattr(k, name)[rows], getattr(new_k, name))
        new_row = {int(row): i for i, row in enumerate(rows)}
        renumbered = [[new_row[i] for i in one.tolist() if i in new_row] for one in lists]
        assert renumbered == [one.tolist() for one in new_lists]


def test_only_descriptors_change(stereo: Path, tmp_path: Path) -> None:  # noqa: F811
    """Pairs of images keep their keypoints."""
    output = written(stereo, tmp_path)
    assert_same_map(orbslam3.read(stereo), orbslam3.read(output))
    old, new = (np.frombuffer(p.read_bytes(), np.uint8) for p in (stereo, output))
    assert len(old) == len(new)
    differ = old != new
    assert differ.sum() > 1000
    for place in _Rows(stereo).described:
        differ[place] = False
    assert not differ.any()
    # What is written again is the same.
    again = tmp_path / "again.osa"
    write_orbslam3(output, again)
    assert again.read_bytes() == output.read_bytes()


def test_broken_files(two_maps: Path, tmp_path: Path) -> None:  # noqa: F811
    def rewrite(path: Path) -> Tracks:
        return orbslam3.read(written(path, tmp_path))

    check_broken_files(two_maps, rewrite, tmp_path, 60)


def test_what_cannot_be_written(two_maps: Path, stereo: Path, tmp_path: Path) -> None:  # noqa: F811
    with pytest.raises(ValueError, match=r"no atlas of ORB-SLAM3, whose other content is kept"):
        export(Path(__file__), tmp_path / "x.osa", "orbslam3")
    with pytest.raises(ValueError, match="no colours"):
        export(two_maps, tmp_path / "x.osa", "orbslam3", tmp_path)
    with pytest.raises(ValueError, match="is an input"):
        export(two_maps, two_maps, "orbslam3")
    with pytest.raises(ValueError, match="holds 2 maps, each in coordinates of its own"):
        export(two_maps, tmp_path / "x.osa", "kapture")
    assert not (tmp_path / "x.osa").exists()
    # Other programs get an atlas of one map.
    assert export(stereo, tmp_path / "model", "kapture")["landmarks"] == 434


@pytest.mark.parametrize("name", ["fly_mono_53kf.osa", "fly_rgbd.osa", "fly_rgbd_boost182.osa"])
def test_real_files(name: str, tmp_path: Path) -> None:
    source = foreign(f"orbslam3/{name}")
    output = written(source, tmp_path)
    assert output.stat().st_size < 0.75 * source.stat().st_size
    assert_same_map(orbslam3.read(source), orbslam3.read(output))


def test_the_program_loads_it_and_recognizes_the_place(tmp_path: Path) -> None:
    if not find_spec("pyorbslam3"):
        pytest.skip("pyorbslam3 is not installed (pip install pyorbslam3, GPL-3)")
    vocabulary = foreign("orbslam3/orbvoc_tiny.txt")

    def run(save: str, load: str, start: float, seed: int) -> str:
        script = Path(__file__).with_name("orbslam3_session.py")
        command = [sys.executable, str(script), str(vocabulary), save, load, f"{start}", f"{seed}"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr[-2000:]
        assert "tracked 100 of 100" in done.stdout
        return done.stdout

    run("first", "-", 0.0, 1)
    facts = export(tmp_path / "first.osa", tmp_path / "small.osa", "orbslam3")
    assert facts["bytes"] < 0.8 * facts["bytes_before"]
    assert "Merge finished" in run("second", "small", 1.3, 2)
    (one,) = orbslam3.read(tmp_path / "second.osa").info["source"]["maps"]
    assert one["keyframes"] > facts["keyframes"]
