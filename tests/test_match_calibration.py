"""Match calibration: the fit, its record in the model file, and its accuracy."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import protomark as pm
from protomark import models, sample
from protomark.cli import app
from protomark.match_calibration import (
    KEY,
    NO_DISTANCE,
    SOURCE_KEY,
    MatchCalibration,
    fit_logistic,
    sigmoid,
    with_calibration,
)
from protomark.matching import MIN_PROBABILITY
from protomark.tracks.file import Tracks
from protomark.training.match_calibration import matches_by_kind, measure_calibration

LIMIT = 600_000


def test_the_fit_finds_the_weights_that_made_the_data() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal((3, -200), (2, 50), (60_000, 2))
    true = np.array([2.5, -1.5, -0.01])
    right = rng.random(len(x)) < sigmoid(true[0] + x @ true[1:])
    found = fit_logistic(x, right, np.ones(len(x)))
    assert found == pytest.approx(true, rel=0.1)
    # Counting a row twice is as good as having it twice.
    twice = fit_logistic(np.vstack([x, x[:9000]]), np.append(right, right[:9000]), np.ones(69_000))
    assert fit_logistic(x, right, 1.0 + (np.arange(60_000) < 9000)) == pytest.approx(
        twice, rel=1e-6
    )


def test_what_is_told_apart_without_exception_has_finite_weights() -> None:
    x = np.linspace(-1, 1, 100)[:, None]
    found = fit_logistic(x, x[:, 0] > 0, np.ones(100))
    assert np.isfinite(found).all()
    assert found[1] > 1
    for same in (np.zeros(100, bool), np.ones(100, bool)):
        with pytest.raises(ValueError, match="needs right and wrong ones"):
            fit_logistic(x, same, np.ones(100))


def test_probability() -> None:
    calibration = MatchCalibration((1.0, -0.05, 0.02))
    away = np.array([[16, 64], [16, NO_DISTANCE], [0, 0], [NO_DISTANCE] * 2], np.int32)
    p = calibration.probability(away)
    logits = [1 - 0.8 + 0.96, 1 - 0.8 + 0.96, 1]
    assert p[:3] == pytest.approx(1 / (1 + np.exp(-np.array(logits))))
    assert p[3] == 0
    assert len(calibration.probability(np.zeros((0, 2)))) == 0


def test_the_note_changes_neither_identity_nor_codes(encoder: pm.Encoder, tmp_path: Path) -> None:
    fitted = {
        (5, False): MatchCalibration((1.0, -2.5, 3e-7)),
        (12, False): MatchCalibration((0.0, 1.0, 12345.6)),
        (12, True): MatchCalibration((0.5, 1.0, 2.0)),
    }
    with_calibration(encoder, fitted, "here, there").save(tmp_path / "x.pme")
    read = pm.Encoder.load(tmp_path / "x.pme")
    assert read.identity == encoder.identity
    assert MatchCalibration.of(read, 5) == fitted[5, False]
    assert MatchCalibration.of(read) == fitted[12, False]
    assert MatchCalibration.of(read, tuned=True) == fitted[12, True]
    with pytest.raises(ValueError, match="no match calibration for tuned prototypes of 5 numbers"):
        read.match_calibration(5, tuned=True)
    assert read.notes[SOURCE_KEY] == "here, there"
    # A map keeps it.
    pm.PrototypeMap(read, 5).save(tmp_path / "m.pmk")
    scene = pm.open(tmp_path / "m.pmk")
    assert MatchCalibration.of(scene.encoder, scene.dim) == fitted[5, False]


def test_without_a_note_the_error_says_what_to_do(encoder: pm.Encoder) -> None:
    with pytest.raises(ValueError, match="protomark calibrate"):
        MatchCalibration.of(encoder, 5)


@pytest.mark.parametrize("note", ["8 1 2", "8 1 2 3 4", "8 1 2 nan", "8 1 2 x", "\n"])
def test_broken_notes(note: str, encoder: pm.Encoder) -> None:
    broken = pm.Encoder(
        encoder.layers, encoder.dims, "tiny", "test", encoder.scale, notes={KEY: note}
    )
    with pytest.raises(ValueError, match="note on match_calibration is broken"):
        MatchCalibration.of(broken, 5)


@pytest.mark.parametrize("name", models.names())
def test_what_ships_is_calibrated_and_as_its_card_says(name: str) -> None:
    encoder = pm.Encoder.load(name)
    path = models.resolve(name)
    size = path.stat().st_size
    assert size <= LIMIT
    card = path.with_suffix(".md").read_text()
    assert f"- file: {size:,} bytes" in card
    assert f"fitted to {encoder.notes[SOURCE_KEY]} " in card
    for test_sequence in ("toy", "kitchen", "castle", "kitti07"):
        assert test_sequence not in encoder.notes[SOURCE_KEY]
    for dim in encoder.dims:
        for tuned in (False, True):
            calibration = encoder.match_calibration(dim, tuned)
            near, far = calibration.probability([[1, 10_000], [39_900, 40_000]])
            assert near > 0.8
            assert near - far > 0.3


def test_probabilities_hold_on_a_sequence_that_they_were_not_fitted_to() -> None:
    encoder = pm.Encoder.load("freak")
    tracks = Tracks.load(sample.path())
    found = matches_by_kind(encoder, tracks, frames=5)
    for kind in product((16, 32, 64), (False, True)):
        figures = measure_calibration("toy", *kind, encoder.match_calibration(*kind), found[kind])
        assert figures.precision == pytest.approx(figures.expected, abs=0.12)
        assert figures.recall > 0.6


def test_match_gives_what_it_promises() -> None:
    tracks = Tracks.load(sample.path())
    rows = tracks.observations
    scene = pm.PrototypeMap(pm.Encoder.load("freak"), 32)
    scene.add(tracks.landmark_of_keypoint[rows], tracks.descriptors[rows])
    frame = tracks.keypoints_of(3)
    matches = pm.match(scene, tracks.descriptors[frame])
    own = tracks.landmark_of_keypoint[frame][matches.keypoints]
    assert len(matches) > 100
    assert matches.probabilities.min() >= MIN_PROBABILITY
    assert (own == matches.landmarks).mean() > 0.6
    assert len(pm.match(scene, tracks.descriptors[:0])) == 0


def test_calibrate_command(tmp_path: Path) -> None:
    pm.Encoder.load("freak").save(tmp_path / "mine.pme")
    command = ["calibrate", str(tmp_path / "mine.pme"), str(sample.path())]
    done = CliRunner().invoke(app, [*command, "-o", str(tmp_path / "new.pme")])
    assert done.exit_code == 0, done.output
    made = pm.Encoder.load(tmp_path / "new.pme")
    assert made.notes[SOURCE_KEY] == "toy"
    assert MatchCalibration.of(made, 8) != MatchCalibration.of(pm.Encoder.load("freak"), 8)
    twice = CliRunner().invoke(app, [*command, str(sample.path())])
    assert "two files are of the sequence toy" in str(twice.exception)
