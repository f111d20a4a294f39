"""What distributed builds stand on, without Ray: pieces of tracks, the plan, names and folders."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conftest import protomark
from protomark import sample
from protomark.tracks.file import ARRAYS

pytest.importorskip("fsspec")

from protomark.distributed import plan, tasks
from protomark.distributed.folder import Folder, file_system, shown
from protomark.distributed.tracks_file import TracksFile


def test_pieces_are_the_whole() -> None:
    toy, file = sample.load(), TracksFile(str(sample.path()))
    for name in ARRAYS:
        whole = getattr(toy, name)
        assert file.rows(name) == len(whole)
        pieces = [file.read(name, i, i + 1000) for i in range(0, len(whole), 1000)]
        assert np.array_equal(np.concatenate(pieces), whole)
    assert file.fields["info"] == toy.info
    assert file.descriptor_bytes == 64


@pytest.mark.parametrize("cut", [3, 200, 70_000, -1])
def test_a_cut_file_is_refused(cut: int, tmp_path: Path) -> None:
    path = tmp_path / "cut.safetensors"
    path.write_bytes(sample.path().read_bytes()[:cut])
    with pytest.raises(ValueError, match=r"cut.safetensors: not a tracks file, or a broken one"):
        TracksFile(str(path))


def test_counts(tmp_path: Path) -> None:
    toy = sample.load()
    ids, counts = np.unique(toy.landmark_of_keypoint[toy.observations], return_counts=True)
    found = tasks.count(str(sample.path()), 0, len(toy.landmark_ids), 4, 32)
    assert (found.observations, found.highest) == (counts.sum(), counts.max())
    assert found.short == (counts < 4).sum()
    assert found.costs.sum() == np.minimum(counts, 32).sum()
    half = [tasks.count(str(sample.path()), a, b, 4, 32) for a, b in ((0, 2000), (2000, 9999))]
    assert sum(one.observations for one in half) == found.observations
    assert len(ids) <= len(toy.landmark_ids)


@given(st.lists(st.lists(st.integers(0, 1000), min_size=1, max_size=9), max_size=9), st.data())
def test_the_plan_has_each_landmark_once_and_fits(costs: list[list[int]], data: Any) -> None:
    room = data.draw(st.integers(1000, 3000))
    memory = plan.WORKER_BYTES + room * plan.PROTOTYPE_BYTES
    shards = plan.cut_segments([np.array(one) for one in costs], memory)
    seen = [segment for shard in shards for segment in shard]
    assert seen == sorted(seen, key=lambda s: (s.source, s.start))
    for source, buckets in enumerate(costs):
        own = [s for s in seen if s.source == source]
        assert [s.start for s in own] == [0, *(s.stop for s in own[:-1])]
        assert own[-1].stop == len(buckets) * plan.BUCKET
    for shard in shards:
        parts = [costs[s.source][s.start // plan.BUCKET : s.stop // plan.BUCKET] for s in shard]
        assert len(shard) > 0
        assert sum(map(sum, parts)) <= room


@given(st.integers(1, 50), st.integers(1, 50))
def test_groups_have_each_segment_once(groups: int, segments: int) -> None:
    groups = min(groups, segments)
    ends = [plan.segments_of(group, groups, segments) for group in range(groups)]
    assert [i for first, last in ends for i in range(first, last)] == list(range(segments))


def test_secrets_are_not_shown() -> None:
    assert shown("s3://key:secret@bucket/a?token=secret#secret") == "s3://bucket/a"
    assert shown("/data/a@b") == "/data/a@b"
    with pytest.raises((ValueError, ModuleNotFoundError)) as failed:
        file_system("nosuch://key:secret@bucket/a")
    assert "secret" not in str(failed.value)


@pytest.mark.parametrize("url", ["memory://city", "local"])
def test_files_of_a_folder(url: str, tmp_path: Path) -> None:
    folder = Folder(url if "://" in url else str(tmp_path / "city"))
    assert folder.names() == []
    assert folder.read("a.json") is None
    assert folder.size("a.json") is None
    folder.remove("a.json")
    folder.write("work/a.json", b"12")
    folder.write("a.json", b"123")
    with folder.workspace("work") as work:
        (work / "b").write_bytes(b"1234")
        folder.publish(work / "b", "b")
    assert sorted(folder.names()) == ["a.json", "b"]
    assert (folder.read("a.json"), folder.size("b")) == (b"123", 4)
    folder.remove("work")
    folder.remove("b")
    assert folder.names() == ["a.json"]
    assert folder.read("work/a.json") is None


def test_without_ray_the_command_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    done = protomark("build", sample.path(), "--ray", "local", "-o", tmp_path / "city")
    assert done.returncode == 1
    assert "this needs Ray, which is not installed: pip install" in done.stderr
    assert not (tmp_path / "city").exists()
