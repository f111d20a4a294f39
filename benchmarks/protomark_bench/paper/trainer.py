"""Trains a network with the paper's objectives, Adam, and the plateau schedule."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from protomark.training.network import EncoderNetwork, embed
from protomark.training.sampling import Views
from protomark.training.validation import Trial, mean_precision
from protomark_bench.paper.objectives import (
    draw_episode,
    draw_triplets,
    prototypical_loss,
    triplet_loss,
)
from protomark_bench.paper.scale import Objective, Scale, Training

# A step has about 1500 descriptors for either objective, so that it costs the same.
TRIPLETS = 512
CLASSES = 320
_VALIDATION_BATCHES = 8

RATE = 0.001
FACTOR = 0.1
DROPS = 2
# With a limit on the steps, the rate falls after this share of them at the latest.
_LATEST_DROP = 0.8


@dataclass(frozen=True)
class PaperData:
    """The data of trainings.

    Attributes:
        training: views of the training sequences.
        validation: views of the validation sequences, for the validation loss.
        trials: splits of the validation sequences, for the precision.
        bits: length of a descriptor.
        fingerprint: digest of the data.
    """

    training: list[Views]
    validation: list[Views]
    trials: list[Trial]
    bits: int
    fingerprint: str


@dataclass(frozen=True)
class TrainingOutcome:
    """A finished training.

    Attributes:
        weights: state of the network at the lowest validation loss, by name.
        precision: precision on validation.
        validation_loss: lowest validation loss.
        best_step: step with that loss.
        steps: number of steps.
        seconds: duration, including validation.
    """

    weights: dict[str, NDArray[np.float32]]
    precision: float
    validation_loss: float
    best_step: int
    steps: int
    seconds: float

    def network(self, training: Training, bits: int) -> EncoderNetwork:
        """The trained network."""
        network = EncoderNetwork(bits, training.dim, training.hidden(bits))
        network.load_state_dict({k: torch.from_numpy(v) for k, v in self.weights.items()})
        return network.eval()


class Plateau:
    """The learning rate, which falls to a tenth whenever the validation loss stagnates.

    The paper states the first rate, the factor and the reason to fall, but not when to end: here at
    the third plateau, at a rate of 0.00001. A training with a limit on its steps ends there, and
    its last fifth runs at a tenth of the rate or less, so that its end is not noisy.

    Args:
        patience: number of epochs without a lower loss that make a plateau.
        steps: limit on the steps, None for none.

    Attributes:
        rate: the current learning rate.
        drops: how often the rate fell.
        best: the lowest loss so far.
        finished: whether the training has ended.
    """

    def __init__(self, patience: int, steps: int | None = None) -> None:
        self.patience = patience
        self.steps = steps
        self.rate = RATE
        self.drops = 0
        self.best = float("inf")
        self.finished = False
        self._stale = 0

    def update(self, step: int, loss: float) -> bool:
        """Record the loss after `step` steps; returns whether it is the lowest so far."""
        better = loss < self.best
        if better:
            self.best, self._stale = loss, 0
        else:
            self._stale += 1
        late = self.steps is not None and step >= _LATEST_DROP * self.steps and self.drops == 0
        if self._stale >= self.patience or late:
            self._fall()
        if self.steps is not None and step >= self.steps:
            self.finished = True
        return better

    def _fall(self) -> None:
        self._stale = 0
        if self.drops == DROPS:
            self.finished = True
            return
        self.drops += 1
        self.rate *= FACTOR


def train(
    training: Training,
    data: PaperData,
    scale: Scale,
    half: bool,
) -> TrainingOutcome:
    """Trains one network.

    Args:
        training: the network, its objective and seed.
        data: what to train and validate on.
        scale: schedule of evaluations, and limit on the steps.
        half: whether matrix products of the steps run in bfloat16.

    Raises:
        ValueError: the loss is no longer finite.
    """
    begin = time.perf_counter()
    torch.manual_seed(training.seed)
    network = EncoderNetwork(data.bits, training.dim, training.hidden(data.bits))
    optimizer = torch.optim.Adam(network.parameters())
    schedule = Plateau(scale.patience, scale.steps)
    sizes = np.array([len(views) for views in data.training], float)
    weights: dict[str, NDArray[np.float32]] = {}
    step, best_step = 0, 0
    while not schedule.finished:
        for group in optimizer.param_groups:
            group["lr"] = schedule.rate
        # Each step has a generator of its own, so that batches do not depend on earlier trainings.
        rng = np.random.default_rng([training.seed, step])
        views = data.training[rng.choice(len(sizes), p=sizes / sizes.sum())]
        loss = batch_loss(network, training.objective, views, rng, half)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        value = float(loss.detach())
        if not math.isfinite(value):
            raise ValueError(
                f"{training.label}: the loss is {value} at step {step}: train another seed"
            )
        optimizer.step()
        step += 1
        if step % scale.epoch == 0 or step == scale.steps:
            found = validation_loss(network, training.objective, data.validation, half)
            if schedule.update(step, found) or not weights:
                best_step = step
                weights = {k: v.numpy().copy() for k, v in network.state_dict().items()}
    network.load_state_dict({k: torch.from_numpy(v) for k, v in weights.items()})
    network.eval()
    precision = mean_precision(data.trials, lambda d: embed(network, d), (training.dim,))
    return TrainingOutcome(
        weights,
        precision[training.dim],
        schedule.best,
        best_step,
        step,
        time.perf_counter() - begin,
    )


def batch_loss(
    network: EncoderNetwork,
    objective: Objective,
    views: Views,
    rng: np.random.Generator,
    half: bool,
) -> Tensor:
    """The objective on a random batch of a sequence, a scalar."""
    if objective == "triplet":
        triplets = draw_triplets(views, TRIPLETS, rng)
        embeddings = _embed(network, views, triplets.reshape(-1), half)
        anchor, positive, negative = embeddings.chunk(3)
        return triplet_loss(anchor, positive, negative)
    episode = draw_episode(views, CLASSES, rng)
    return prototypical_loss(
        _embed(network, views, episode.rows, half),
        torch.from_numpy(episode.classes),
        torch.from_numpy(episode.is_query),
    )


@torch.no_grad()
def validation_loss(
    network: EncoderNetwork, objective: Objective, sequences: Sequence[Views], half: bool
) -> float:
    """Mean loss over fixed batches of each sequence."""
    rng = np.random.default_rng(0)
    return float(
        np.mean(
            [
                float(batch_loss(network, objective, views, rng, half))
                for views in sequences
                for _ in range(_VALIDATION_BATCHES)
            ]
        )
    )


def _embed(network: EncoderNetwork, views: Views, rows: NDArray[np.int64], half: bool) -> Tensor:
    with torch.autocast("cpu", torch.bfloat16, enabled=half):
        embeddings: Tensor = network(network.scaling.inputs(views.descriptors[rows]))
    return embeddings.float()
