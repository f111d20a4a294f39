from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

import protomark as pm
from conftest import random_layers
from protomark import sample
from protomark.build import build_map
from protomark.cli import app
from protomark.evaluation.results import load_json
from protomark.sized import BYTES, sized_descriptors, sized_tracks
from protomark.upright import upright_descriptors
from training_scene import scene

runner = CliRunner()


def added(size: float) -> list[int]:
    """Which of the 32 bits are set."""
    longer = sized_descriptors(np.zeros((1, 4), np.uint8), [size])
    return np.flatnonzero(np.unpackbits(longer[0, 4:], bitorder="little")).tolist()


def test_size_sets_its_quarter_octave_and_two_on_either_side():
    assert added(12.0) == [2, 3, 4, 5, 6]
    assert added(1.0) == [0, 1, 2]
    assert added(1e6) == [29, 30, 31]


@pytest.mark.parametrize("value", [-1.0, 0.0, np.nan, np.inf])
def test_unknown_sets_nothing(value):
    assert added(value) == []


@given(st.floats(9, 400), st.floats(9, 400), st.floats(9, 400))
def test_farther_sizes_share_no_more_bits(a, b, c):
    near, middle, far = sorted((a, b, c))
    assert len({*added(near)} & {*added(far)}) <= len({*added(near)} & {*added(middle)})


def test_descriptors_stay_and_shapes_must_fit():
    rng = np.random.default_rng(0)
    descriptors = rng.integers(0, 256, (7, 64), np.uint8)
    sizes = rng.uniform(5, 50, 7)
    longer = pm.sized_descriptors(descriptors, sizes)
    assert longer.shape == (7, 64 + BYTES)
    np.testing.assert_array_equal(longer[:, :64], descriptors)
    # The same bits as upright descriptors end with.
    upright = upright_descriptors(descriptors, np.zeros(7), sizes)
    np.testing.assert_array_equal(longer[:, 64:], upright[:, 68:])
    with pytest.raises(ValueError, match="do not fit together"):
        pm.sized_descriptors(descriptors, np.zeros(6))


def test_tracks_whose_sizes_say_nothing_are_refused():
    tracks = sample.load()
    assert sized_tracks(tracks).descriptor == "freak-sized"
    assert sized_tracks(tracks).bits == tracks.bits + 8 * BYTES
    tracks.sizes = np.ones_like(tracks.sizes)
    with pytest.raises(ValueError, match="all keypoints of these freak tracks have the same size"):
        sized_tracks(tracks)


@pytest.fixture
def encoder(tmp_path):
    made = pm.Encoder(
        random_layers([544, 32, 16]), [16], name="s", descriptor="freak-sized", scale=0.02
    )
    made.save(tmp_path / "s.pme")
    return made


def test_evaluate_gives_only_our_methods_the_longer_descriptors(tmp_path, encoder):
    words = ["evaluate", str(sample.path()), "--encoder", str(tmp_path / "s.pme"), "--seeds", "1"]
    words += ["--methods", "medoid,protomark-16", "--pose-frames", "2", "--sized"]
    done = runner.invoke(app, [*words, "--json", str(tmp_path / "s.json")])
    assert done.exit_code == 0, done.output
    (result,) = load_json(tmp_path / "s.json")
    medoid, ours = result.methods
    assert medoid.bytes_per_landmark == [64]
    assert ours.precision[0] > 0.05


def test_build_takes_them_with_the_option_and_names_it_without(tmp_path, encoder):
    words = ["build", str(sample.path()), "--encoder", str(tmp_path / "s.pme")]
    words += ["-o", str(tmp_path / "s.pmk")]
    done = runner.invoke(app, [*words, "--sized"])
    assert done.exit_code == 0, done.output
    built = pm.open(tmp_path / "s.pmk")
    expected = build_map(sized_tracks(sample.load()), encoder)
    np.testing.assert_array_equal(built.prototype(built.ids), expected.prototype(expected.ids))
    with pytest.raises(ValueError, match="choose an encoder for freak, or build with --sized"):
        build_map(sample.load(), encoder)


def test_upright_and_sized_together_are_refused(tmp_path, encoder):
    words = ["build", str(sample.path()), "-o", str(tmp_path / "s.pmk"), "--upright", "--sized"]
    done = runner.invoke(app, words)
    assert isinstance(done.exception, ValueError)
    assert "give --upright or --sized" in str(done.exception)
    assert not (tmp_path / "s.pmk").exists()


def test_training_learns_from_sizes_and_the_card_says_so(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for seed, name in enumerate(("learned", "picking")):
        tracks = scene(seed=seed)
        own = np.random.default_rng(seed).uniform(8, 200, len(tracks.landmark_ids))
        tracks.sizes = own[tracks.landmark_of_keypoint].astype(np.float32)
        tracks.save(f"{name}.safetensors")
    words = ["train", "learned.safetensors", "picking.safetensors", "--dims", "8"]
    words += ["--steps", "60", "--batch", "200", "--threads", "1"]
    found = {}
    for further in ([], ["--sized"]):
        done = runner.invoke(app, [*words, *further, "--json", "card.json"])
        assert done.exit_code == 0, done.output
        (figures,) = json.loads(Path("card.json").read_text())["figures"]
        found[tuple(further)] = figures["integer_precision"]["8"], figures["unaggregated"]
    # The baselines beside it are those of the plain descriptors.
    assert found["--sized",][1] == found[()][1]
    assert found["--sized",][0] > found[()][0] + 0.1
    encoder = pm.Encoder.load("synthetic-sized.pme")
    assert (encoder.descriptor, encoder.bits) == ("synthetic-sized", 160)
    assert "-o synthetic-sized.pme --sized --dims 8" in Path("synthetic-sized.md").read_text()
