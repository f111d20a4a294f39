"""`protomark demo` on the shipped sample, and its handling of existing outputs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import protomark as pm
from conftest import protomark
from evaluation_scene import looking_inwards, ring_scene
from protomark import sample
from protomark.cli.terminal import readable_size
from protomark.evaluation.demo import LEARNING_MAP, PICTURE, SEALED_MAP, run_demo
from protomark.evaluation.protocol import split
from protomark.geometry.pose import ground_plane
from protomark.tracks.file import Tracks


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_on_the_sample(tmp_path: Path) -> None:
    done = protomark("demo", "--json", "figures.json")
    assert done.returncode == 0, done.stderr
    facts = json.loads((tmp_path / "figures.json").read_text())
    rows = {row["name"]: row for row in facts["table"]}
    whole, ours, pca = rows["unaggregated"], rows["protomark-32"], rows["pca-32"]
    assert ours["bytes_per_landmark"] == 33
    assert ours["precision"] > pca["precision"]
    assert 0.5 < ours["precision"] / whole["precision"] < 1
    # Tracks of a good reconstruction: every query is found.
    assert ours["pose_recall"] == whole["pose_recall"] == 1
    for name in (PICTURE, LEARNING_MAP, SEALED_MAP):
        assert facts["files"][name] == (tmp_path / "demo" / name).stat().st_size
    assert done.stdout.splitlines()[-2].startswith("What it means: 32 bytes per landmark")
    assert done.stdout.splitlines()[-1].startswith("What next: `protomark map")

    # The maps that were written hold the support and nothing else.
    tracks = Tracks.load(sample.path())
    rows_of_map = split(tracks, 0).support_rows
    for scene in (
        pm.open(tmp_path / "demo" / LEARNING_MAP),
        pm.open(tmp_path / "demo" / SEALED_MAP),
    ):
        assert np.array_equal(scene.ids, np.unique(tracks.landmark_of_keypoint[rows_of_map]))
        if isinstance(scene, pm.PrototypeMap):
            assert scene.counts(scene.ids).sum() == len(rows_of_map)


def test_the_sample_says_where_it_is_from() -> None:
    assert sample.path().stat().st_size <= 6_000_000
    tracks = Tracks.load(sample.path())
    assert tracks.descriptor == "freak"
    assert tracks.info["sequence"] == "toy"


@pytest.fixture
def ring(tmp_path: Path) -> Path:
    ring_scene().save(tmp_path / "ring.safetensors")
    return tmp_path / "ring.safetensors"


@pytest.fixture
def model(encoder: pm.Encoder, tmp_path: Path) -> str:
    encoder.save(tmp_path / "tiny.pme")
    return str(tmp_path / "tiny.pme")


def test_again_replaces_its_own_files_and_no_others(ring: Path, model: str, tmp_path: Path) -> None:
    output = tmp_path / "new" / "folder"
    first = run_demo(output, tracks_path=ring, encoder=model)
    (output / "notes.txt").write_text("mine")
    second = run_demo(output, tracks_path=ring, encoder=model)
    assert [m.precision for m in first.comparison.methods] == [
        m.precision for m in second.comparison.methods
    ]
    assert (output / "notes.txt").read_text() == "mine"
    names = {path.name for path in output.iterdir()}
    assert names == {PICTURE, LEARNING_MAP, SEALED_MAP, "notes.txt"}


@pytest.mark.parametrize("name", [PICTURE, LEARNING_MAP, SEALED_MAP])
def test_what_it_did_not_write_stays(ring: Path, model: str, tmp_path: Path, name: str) -> None:
    output = tmp_path / "demo"
    output.mkdir()
    (output / name).write_bytes(b"mine")
    done = protomark("demo", "--tracks", ring, "--encoder", model)
    assert done.returncode == 1
    assert f"{name} was not written by `protomark demo`" in done.stderr
    assert (output / name).read_bytes() == b"mine"
    assert [path.name for path in output.iterdir()] == [name]


@pytest.mark.parametrize("name", [LEARNING_MAP, SEALED_MAP])
def test_a_map_of_the_users_stays(
    ring: Path, model: str, encoder: pm.Encoder, tmp_path: Path, name: str
) -> None:
    pm.PrototypeMap(encoder).save(tmp_path / name)
    before = (tmp_path / name).read_bytes()
    with pytest.raises(FileExistsError, match="was not written by `protomark demo`"):
        run_demo(tmp_path, tracks_path=ring, encoder=model)
    assert (tmp_path / name).read_bytes() == before


def test_a_run_cut_short_leaves_nothing_in_the_way(
    ring: Path, model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    output = tmp_path / "demo"
    with monkeypatch.context() as patch:
        patch.setattr("protomark.evaluation.demo._draw", interrupt)
        with pytest.raises(KeyboardInterrupt):
            run_demo(output, tracks_path=ring, encoder=model)
    assert list(output.iterdir()) == []
    assert (output / SEALED_MAP).name in run_demo(output, tracks_path=ring, encoder=model).files


def test_mistakes_are_one_sentence(ring: Path, model: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for arguments, message in (
        (["-o", "file", "--encoder", model, "--tracks", ring], "file is not a folder"),
        (["--tracks", "none"], "none: no such tracks file"),
        (["--tracks", ring, "--encoder", "none"], "none: neither a model file nor a bundled"),
        (["--json", "no/such.json"], "no: no such folder"),
    ):
        done = protomark("demo", *arguments)
        assert done.returncode == 1
        assert message in done.stderr
        assert "Traceback" not in done.stderr
    assert not (tmp_path / "demo").exists()


def test_an_encoder_for_other_descriptors_is_refused(
    encoder: pm.Encoder, tmp_path: Path, model: str
) -> None:
    ring_scene(bits=128).save(tmp_path / "wide.safetensors")
    with pytest.raises(ValueError, match="choose an encoder for test"):
        run_demo(tmp_path / "out", tracks_path=tmp_path / "wide.safetensors", encoder=model)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("down", [False, True])
def test_above_is_above(down: bool) -> None:
    """A ring of cameras in the plane y = 0 is seen in its full width, looking in or down."""
    poses = np.array([looking_inwards(a) for a in np.linspace(0, 6, 30)])
    if down:
        centres = -np.einsum("nji,nj->ni", poses[:, :, :3], poses[:, :, 3])
        looks_down = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
        poses[:, :, :3] = looks_down
        poses[:, :, 3] = -centres @ looks_down.T
    plane = ground_plane(poses)
    assert plane @ plane.T == pytest.approx(np.eye(2), abs=1e-12)
    assert plane[:, 1] == pytest.approx(np.zeros(2), abs=1e-12)
    # Right-handed about up, which is -y: the picture is not mirrored.
    assert np.cross(plane[0], plane[1]) == pytest.approx(np.array([0, -1, 0]), abs=1e-12)


def test_view_without_any_spread() -> None:
    plane = ground_plane(np.array([looking_inwards(0.3)]))
    assert plane @ plane.T == pytest.approx(np.eye(2), abs=1e-9)


def test_sizes() -> None:
    assert [readable_size(n) for n in (900, 262_400, 2_550_000)] == ["1 KB", "262 KB", "2.55 MB"]
