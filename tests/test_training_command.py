from __future__ import annotations

import json
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

import protomark as pm
from protomark.cli import app
from protomark.match_calibration import MatchCalibration
from protomark.tracks.file import Tracks
from protomark.training.data import load_training
from training_scene import scene


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tracks")
    made = {
        "a": scene(seed=1),
        "b": scene(seed=2),
        "unseen": scene(seed=3),
        "other": scene(seed=4, descriptor="else"),
        "longer": scene(seed=4, bits=256),
        "tiny": scene(landmarks=40, seed=5),
        "short": scene(landmarks=600, keyframes=2, seed=6),
        "narrow": scene(bits=32, seed=7),
    }
    paths = {}
    for name, tracks in made.items():
        paths[name] = folder / f"{name}.synthetic.safetensors"
        tracks.save(paths[name])
    return paths


def run(*words):
    return CliRunner().invoke(app, ["train", *map(str, words)])


def test_one_command_from_tracks_to_an_encoder_and_its_card(files, tmp_path):
    out = tmp_path / "mine.pme"
    result = run(
        files["a"], files["b"], "--validation", files["unseen"], "-o", out, "--dims", "4,8",
        "--steps", 60, "--batch", 200, "--threads", 1, "--licence", "Apache-2.0",
        "--data-licence", "b=MIT",
        "--json", tmp_path / "mine.json",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "mine.json", "mine.md", "mine.pme", "mine.png",
    ]  # fmt: skip

    encoder = pm.Encoder.load(out)
    assert (encoder.name, encoder.descriptor, encoder.bits) == ("mine", "synthetic", 128)
    assert list(encoder.dims) == [4, 8]
    assert encoder.licence == "Apache-2.0"
    assert encoder.data == "a (CC0-1.0); b (MIT)"
    codes = encoder.encode(Tracks.load(files["unseen"]).descriptors)
    # Clamping is rare, and the codes use what 8 bits offer.
    assert (np.abs(codes.astype(int)) == 127).mean() < 0.01
    assert codes.std() > 15

    # Which matches to accept is fitted at the end, and the card says to what.
    near, far = MatchCalibration.of(encoder, 8).probability([[400, 3600], [400, 441]])
    assert near > far

    figures = json.loads((tmp_path / "mine.json").read_text())
    assert figures["calibrated_on"] == "a, b, unseen"
    (validation,) = figures["figures"]
    assert validation["sequence"] == "unseen"
    assert validation["integer_precision"]["8"] > 0.3
    assert validation["integer_precision"]["8"] == pytest.approx(
        validation["float_precision"]["8"], abs=0.03
    )
    assert figures["bytes"] == out.stat().st_size
    # One binary descriptor a landmark is far above chance (1 in 1200) and below all of them.
    for one in ("medoid", "majority"):
        assert 0.02 < validation[one] < validation["unaggregated"]
    card = (tmp_path / "mine.md").read_text()
    assert (
        "protomark train a.synthetic.safetensors b.synthetic.safetensors --validation "
        "unseen.synthetic.safetensors -o mine.pme --dims 4,8 --steps 60 --batch 200 "
        "--licence Apache-2.0 --data-licence b=MIT"
    ) in card
    assert f"{validation['integer_precision']['8']:.4f}" in card
    assert "fitted to a, b, unseen " in card
    assert "![loss and validation precision](mine.png)" in card
    assert str(tmp_path) not in card


@pytest.mark.parametrize(
    ("training", "validation", "message"),
    [
        (["a", "other"], ["unseen"], "give tracks of one descriptor"),
        (["a", "longer"], ["unseen"], "give tracks of one descriptor"),
        (["a"], ["other"], "give tracks of one descriptor"),
        (["a", "b"], ["b"], "not trained on"),
        (["tiny"], ["unseen"], "give more or longer tracks"),
        (["a", "short"], ["unseen"], "short.*the 3 views that training needs"),
        (["a"], ["short"], "short.*support observations|too short"),
        (["narrow"], ["unseen"], "64 to 1024 bits"),
        ([], ["unseen"], "no training tracks"),
        (["a"], [], "--validation"),
    ],
)
def test_data_that_cannot_be_trained_on(files, training, validation, message):
    with pytest.raises(ValueError, match=message):
        load_training([files[n] for n in training], [files[n] for n in validation])


def test_augmented_copies_of_the_validation_sequence_are_not_trained_on(tmp_path):
    tracks = scene(seed=1)
    tracks.info["input"] = "digest of the images"
    plain, augmented = tmp_path / "yard.x.safetensors", tmp_path / "yard.x.augmented.safetensors"
    tracks.save(plain)
    tracks.info["augmentations"] = 1
    tracks.save(augmented)
    with pytest.raises(
        ValueError, match=r"yard\.x\.safetensors and yard\.x\.augmented.*same images"
    ):
        load_training([augmented], [plain])


def test_a_missing_file_is_named(files, tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        load_training([files["a"], tmp_path / "nowhere"], [files["unseen"]])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--dims", "8;16"], "list of numbers"),
        (["--dims", "16,8"], "ascending"),
        (["--steps", "0"], "steps"),
        (["--device", "abacus"], "cpu or cuda"),
        (["--resume"], "without --resume"),
        (["--data-licence", "MIT"], "NAME=LICENCE"),
        (["--data-licence", "z=MIT"], "not one of the sequences"),
        (["-o", "no/such/folder/x.pme"], "no such folder to write"),
        (["--report", "nowhere.safetensors"], "nowhere"),
        (["--report", "{longer}"], "give tracks of one descriptor"),
        (["--report", "{short}"], "short"),
        (["-o", "{tmp_path}"], "is a folder"),
        (["-o", "{tmp_path}/x.md"], "name the model .pme"),
        (["--json", "{tmp_path}"], "is a folder"),
    ],
)
def test_bad_options_stop_before_the_first_step(files, tmp_path, words, message):
    out = tmp_path / "x.pme"
    words = [word.format(tmp_path=tmp_path, **files) for word in words]
    result = run(files["a"], "--validation", files["unseen"], "-o", out, *words)
    assert isinstance(result.exception, (ValueError, OSError))
    assert message in str(result.exception)
    assert list(tmp_path.iterdir()) == []


def test_without_torch_it_says_what_to_install(files, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    result = run(files["a"], "--validation", files["unseen"], "-o", tmp_path / "x.pme")
    assert "PyTorch, which is not installed: pip install '" in str(result.exception)


def test_without_options_the_last_file_picks_and_the_descriptor_names_the_model(
    files, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    words = [files["a"], files["b"], files["unseen"], "--steps", 20, "--batch", 100]
    words += ["--dims", "4,8", "--threads", 1]
    result = run(*words)
    assert result.exit_code == 0, result.output
    card = (tmp_path / "synthetic.md").read_text()
    assert "| unseen | validation |" in card
    assert "| b | training |" in card
    before = (tmp_path / "synthetic.pme").read_bytes()
    again = run(*words)
    assert isinstance(again.exception, FileExistsError)
    assert "synthetic.pme exists already" in str(again.exception)
    assert (tmp_path / "synthetic.pme").read_bytes() == before
    (tmp_path / "synthetic.pme").unlink()
    assert "synthetic.md exists already" in str(run(*words).exception)


def test_one_file_cannot_do_both(files):
    result = run(files["a"])
    assert isinstance(result.exception, ValueError)
    assert "cannot serve for training and validation" in str(result.exception)
