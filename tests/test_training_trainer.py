from __future__ import annotations

import os
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch

from conftest import reference_encode
from protomark.interrupt import Interrupted
from protomark.training.network import embed
from protomark.training.sampling import Views
from protomark.training.train import Trainer, TrainingOptions
from protomark.training.validation import Trial, precision
from training_scene import scene

SMALL = TrainingOptions(
    dims=(4, 8), hidden=(64, 32), steps=120, landmarks=200, views=6, validate_every=30, seed=3
)


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def views():
    return [Views.from_tracks(scene(seed=s), str(s)) for s in (1, 2)]


@pytest.fixture(scope="module")
def trial():
    return Trial.from_tracks(scene(seed=7), "unseen")


def nothing(step, loss, progress):
    pass


def pca_precision(trial: Trial, dims) -> dict[int, float]:
    """PCA fitted on the support, with means in float: the baseline without rounding."""
    bits = np.unpackbits(trial.support, axis=1).astype(np.float32)
    mean = bits.mean(0)
    _, axes = np.linalg.eigh(np.cov((bits - mean).T))
    axes = axes[:, ::-1].astype(np.float32)
    return precision(trial, lambda d: (np.unpackbits(d, axis=1) - mean) @ axes, dims)


def raw_precision(trial: Trial) -> float:
    """Precision of the nearest raw descriptor."""
    signs = [
        2.0 * np.unpackbits(d, axis=1).astype(np.float32) - 1
        for d in (trial.support, trial.queries)
    ]
    landmarks = np.repeat(
        np.arange(len(trial.starts)), np.diff(np.append(trial.starts, len(trial.support)))
    )
    nearest = (signs[1] @ signs[0].T).argmax(1)
    return float((landmarks[nearest] == trial.targets).mean())


def test_beats_pca_and_raw_descriptors_on_a_scene_it_never_saw(views, trial):
    trainer = Trainer(views, [trial], replace(SMALL, steps=400, validate_every=100))
    untrained = precision(trial, lambda d: embed(trainer.network, d), (4, 8))
    trainer.run(nothing)
    layers = trainer.quantized.export()
    ours = precision(trial, lambda d: reference_encode(layers, d), (4, 8))
    floats = precision(trial, lambda d: embed(trainer.network, d), (4, 8))
    pca = pca_precision(trial, (4, 8))
    for d in (4, 8):
        assert ours[d] > pca[d] + 0.1
        assert ours[d] > untrained[d] + 0.1
        assert ours[d] == pytest.approx(floats[d], abs=0.02)
    assert ours[8] > raw_precision(trial) + 0.05
    assert ours[8] > ours[4]
    losses = [p.loss for p in trainer.history]
    assert losses[-1] < losses[0]


def test_keeps_the_best_quantised_weights(views, trial):
    trainer = Trainer(views, [trial], replace(SMALL, quantized_share=0.75, validate_every=15))
    trainer.run(nothing)
    candidates = [p for p in trainer.history if p.quantized]
    assert len(candidates) == 6
    best = max(candidates, key=lambda p: p.mean_precision)
    assert trainer.best_step == best.step
    assert precision(trial, lambda d: embed(trainer.quantized, d), (4, 8)) == best.precision


@pytest.mark.parametrize("stop", [40, 105])
def test_resumed_training_equals_uninterrupted(views, trial, tmp_path, stop):
    whole = Trainer(views, [trial], SMALL)
    whole.run(nothing)

    def press_ctrl_c(step, loss, progress):
        if step == stop:
            os.kill(os.getpid(), signal.SIGINT)

    path = tmp_path / "x.checkpoint"
    first = Trainer(views, [trial], SMALL, path)
    with pytest.raises(Interrupted, match=f"after step {stop};"):
        first.run(press_ctrl_c)
    assert [p.name for p in tmp_path.iterdir()] == ["x.checkpoint"]
    second = Trainer(views, [trial], SMALL, path)
    second.resume()
    assert second.step == stop
    second.run(nothing)

    for key, value in whole.quantized.state_dict().items():
        assert torch.equal(value, second.quantized.state_dict()[key]), key
    assert [(p.step, p.loss, p.precision) for p in whole.history] == [
        (p.step, p.loss, p.precision) for p in second.history
    ]


def test_seeds_decide_the_weights(views, trial):
    short = replace(SMALL, steps=5)
    states = []
    for seed in (1, 1, 2):
        trainer = Trainer(views, [trial], replace(short, seed=seed))
        trainer.run(nothing)
        states.append(trainer.network.layers[0].weight.detach().clone())
    assert torch.equal(states[0], states[1])
    assert not torch.equal(states[0], states[2])


def test_resume_refuses_what_does_not_fit(views, trial, tmp_path):
    path = tmp_path / "x.checkpoint"
    short = replace(SMALL, steps=4)
    with pytest.raises(FileNotFoundError, match="without --resume"):
        Trainer(views, [trial], short, path).resume()
    Trainer(views, [trial], short, path, fingerprint="a").run(nothing)
    with pytest.raises(ValueError, match="other tracks"):
        Trainer(views, [trial], short, path, fingerprint="b").resume()
    with pytest.raises(ValueError, match="seed 3, not 4"):
        Trainer(views, [trial], replace(short, seed=4), path, fingerprint="a").resume()
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match="broken"):
        Trainer(views, [trial], short, path, fingerprint="a").resume()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dims": ()}, "dims"),
        ({"dims": (16, 8)}, "ascending"),
        ({"dims": (0, 8)}, "positive"),
        ({"dims": (8, 300)}, "255"),
        ({"steps": 0}, "steps"),
        ({"landmarks": 1}, "landmarks is 1, it must be at least 2"),
        ({"views": 2}, "views"),
    ],
)
def test_options_that_make_no_sense(change, message):
    with pytest.raises(ValueError, match=message):
        replace(SMALL, **change).check()


def test_a_diverging_training_says_so(views, trial):
    with pytest.raises(ValueError, match="learning rate"):
        Trainer(views, [trial], replace(SMALL, learning_rate=1e30, clip=1e30)).run(nothing)
