from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from protomark.training.network import embed
from protomark.training.sampling import Views
from protomark.training.validation import Trial, precision
from protomark_bench.cache import ResultCache, key_of
from protomark_bench.paper.scale import (
    PAPER_PICK,
    SCALES,
    Scale,
    Training,
    depth_trainings,
    find_scale,
    measured_trainings,
)
from protomark_bench.paper.trainer import PaperData, Plateau, train
from protomark_bench.paper.workers import Trainings
from training_scene import scene


def test_networks_are_the_papers():
    assert PAPER_PICK.hidden(512) == (512, 256)
    assert Training("triplet", "funnel", 5).hidden(512) == (512, 256, 128, 64)
    assert Training("triplet", "fat", 4).hidden(512) == (512, 512, 512)
    assert Training("triplet", "fat", 2).hidden(512) == (512,)


def test_every_training_is_asked_for_once():
    depth = depth_trainings()
    assert len(depth) == len(set(depth)) == 16
    assert len({(t.objective, t.hidden(512)) for t in depth}) == 14
    assert {(t.dim, t.seed) for t in measured_trainings(PAPER_PICK)} == {
        (8, 0), (16, 0), (32, 0), (64, 0), (16, 1), (16, 2), (32, 1), (32, 2)
    }  # fmt: skip
    assert PAPER_PICK in depth
    assert PAPER_PICK in measured_trainings(PAPER_PICK)


def test_the_rate_falls_on_plateaus_and_the_third_one_ends():
    plateau = Plateau(patience=2)
    rates = []
    for step, loss in enumerate([5, 4, 4, 4, 3, 3, 3, 2, 2.5, 2], start=1):
        assert not plateau.finished
        plateau.update(step, loss)
        rates.append(plateau.rate)
    assert rates == pytest.approx([1e-3] * 3 + [1e-4] * 3 + [1e-5] * 4)
    assert plateau.finished
    assert plateau.best == 2


def test_a_limited_training_slows_down_and_ends():
    plateau = Plateau(patience=100, steps=100)
    rates = []
    for step in range(10, 101, 10):
        assert not plateau.finished
        assert plateau.update(step, 1 / step)
        rates.append(plateau.rate)
    assert rates == pytest.approx([1e-3] * 7 + [1e-4] * 3)
    assert plateau.finished


def test_scales():
    assert [find_scale(name).name for name in SCALES] == ["small", "medium", "full"]
    with pytest.raises(ValueError, match="--scale 'tiny' is unknown: give small, medium, full"):
        find_scale("tiny")


@pytest.fixture(scope="module")
def data():
    tracks = [scene(landmarks=500, seed=seed) for seed in (1, 2)]
    views = [Views.from_tracks(t, str(i)) for i, t in enumerate(tracks)]
    trial = Trial.from_tracks(tracks[1], "1")
    return PaperData(views[:1], views[1:], [trial], 128, "made")


@pytest.mark.parametrize("objective", ["triplet", "prototypical"])
def test_training_learns(data, objective):
    training = Training(objective, "funnel", 2, dim=8)
    longer = train(training, data, Scale("s", steps=60, epoch=20, patience=9), half=False)
    shorter = train(training, data, Scale("s", steps=1, epoch=1, patience=9), half=False)
    assert longer.precision > shorter.precision + 0.05
    assert longer.validation_loss < 0.9 * shorter.validation_loss
    assert longer.best_step in (20, 40, 60)
    network = longer.network(training, 128)
    (trial,) = data.trials
    assert precision(trial, lambda d: embed(network, d), (8,))[8] == longer.precision


def test_a_limit_that_is_no_whole_number_of_epochs(data):
    outcome = train(PAPER_PICK, data, Scale("s", steps=5, epoch=3, patience=9), half=False)
    assert outcome.best_step in (3, 5)
    assert outcome.steps == 5


def test_a_cached_training_is_not_run_again(data, tmp_path, monkeypatch):
    scale = Scale("s", steps=2, epoch=1, patience=9)
    made = Trainings(data, scale, ResultCache(tmp_path), False, 1, 1).run([PAPER_PICK])[PAPER_PICK]
    again = Trainings(data, scale, ResultCache(tmp_path), False, 1, 1)
    found = again.run([PAPER_PICK])[PAPER_PICK]
    assert again.made == 0
    assert dataclasses.replace(found, weights={}) == dataclasses.replace(made, weights={})
    assert found.weights.keys() == made.weights.keys()
    for name, value in made.weights.items():
        np.testing.assert_array_equal(found.weights[name], value)


def test_a_broken_file_counts_as_missing(tmp_path):
    cache = ResultCache(tmp_path)
    cache.save("b", {"precision": 0.5})
    assert cache.load("b") == {"precision": 0.5}
    (tmp_path / "a.safetensors").write_bytes(b"\x08\0\0\0\0\0\0\0broken")
    (tmp_path / "a.json").write_text('{"precision": 0.')
    assert cache.load_arrays("a") is None
    assert cache.load("a") is None
    assert cache.load("c") is None


def test_keys_tell_settings_apart(data, tmp_path):
    assert key_of(a=1, b=2) == key_of(b=2, a=1) != key_of(a=1, b=3)

    def key(training=PAPER_PICK, steps=5, half=False, made_of="made"):
        scale = Scale("s", steps=steps, epoch=3, patience=9)
        changed = dataclasses.replace(data, fingerprint=made_of)
        return Trainings(changed, scale, ResultCache(tmp_path), half, 1, 1).key(training)

    keys = [
        key(),
        key(PAPER_PICK.like(16, seed=1)),
        key(PAPER_PICK.like(8)),
        key(Training("prototypical", "funnel", 3)),
        key(Training("triplet", "fat", 3)),
        key(steps=6),
        key(half=True),
        key(made_of="else"),
    ]
    assert len(set(keys)) == len(keys)
    assert key(Training("triplet", "fat", 2)) == key(Training("triplet", "funnel", 2))


def test_another_process_trains_what_this_one_trains(data, tmp_path):
    asked = [PAPER_PICK]
    scale = Scale("s", steps=4, epoch=2, patience=9)
    found = [
        Trainings(data, scale, ResultCache(tmp_path / str(jobs)), False, jobs, 1).run(asked)
        for jobs in (1, 2)
    ]
    here, apart = (results[PAPER_PICK] for results in found)
    assert dataclasses.replace(here, weights={}, seconds=0) == dataclasses.replace(
        apart, weights={}, seconds=0
    )
    for name, value in here.weights.items():
        np.testing.assert_array_equal(apart.weights[name], value)
