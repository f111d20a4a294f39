"""Two changes of the recipe that were tried: mined negatives, and an average-precision loss.

Neither is part of `protomark train`; `training_ablation.py` measures both.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import protomark as pm
from protomark.training.loss import PrototypeLoss
from protomark.training.sampling import BatchSampler
from protomark.training.train import Trainer


class MinedSampler(BatchSampler):
    """Batches of landmarks that the network confuses, found in maps of the training sequences.

    A batch is anchors drawn at random, the landmarks other than itself that are nearest to one
    view of each anchor, and more random landmarks up to the size of the batch. Until the first
    maps are built, all are random.

    Args:
        trainer: its network makes the codes, its sampler gives sequences and sizes.
        share: about this share of a batch is anchors and their neighbours, 0 to 1.
        nearest: neighbours of an anchor.
        every: steps between new maps of all landmarks by the network as it is then.
    """

    def __init__(self, trainer: Trainer, share: float, nearest: int = 3, every: int = 75) -> None:
        self.__dict__.update(vars(trainer.sampler))
        self.trainer = trainer
        self.share = share
        self.nearest = nearest
        self.every = every
        self.maps: list[pm.PrototypeMap] = []

    def choose(self, sequence: int, rng: np.random.Generator) -> NDArray[np.int64]:
        """Anchors, their neighbours and random landmarks, all distinct."""
        step = self.trainer.step
        if step and step % self.every == 0:
            self._build_maps()
        if not self.maps:
            return super().choose(sequence, rng)
        views = self.sequences[sequence]
        size = min(self.landmarks, len(views))
        order = rng.permutation(len(views))
        anchors = order[: round(self.share * size / (1 + self.nearest))]
        rows = views.starts[anchors] + rng.integers(views.counts[anchors])
        found, _ = self.maps[sequence].search(views.descriptors[rows], self.nearest + 1)
        others = found[found != anchors[:, None]]
        mined = np.concatenate([anchors, rng.permutation(others[others >= 0])])
        chosen = np.concatenate([mined[: round(self.share * size)], order])
        _, first = np.unique(chosen, return_index=True)
        return chosen[np.sort(first)[:size]]

    def _build_maps(self) -> None:
        trainer = self.trainer
        if trainer.step < trainer.options.quantized_from:
            trainer.calibrate()
        encoder = pm.Encoder(
            [{**layer} for layer in trainer.quantized.export()],
            dims=list(trainer.options.dims),
            name="mining",
            descriptor="mining",
            scale=float(trainer.quantized.scale),
        )
        self.maps = []
        for views in self.sequences:
            built = pm.PrototypeMap(encoder)
            built.add(np.repeat(np.arange(len(views)), views.counts), views.descriptors)
            self.maps.append(built)


class AveragePrecisionLoss(PrototypeLoss):
    """Smooth average precision (Brown et al., *Smooth-AP*, ECCV 2020) of a query's one prototype.

    With one right answer average precision is 1 / rank; the rank is 1 and a sigmoid for each other
    prototype, of the difference of logits. Temperatures stay as they are set: they would only
    sharpen the sigmoids.
    """

    def of_logits(self, logits: Tensor, target: Tensor) -> Tensor:
        """1 - 1 / rank, averaged over queries."""
        own = logits.gather(1, target[:, None])
        # A prototype is half before itself: sigmoid(0).
        rank = 0.5 + torch.sigmoid(logits - own).sum(1)
        return (1 - 1 / rank).mean()

    def forward(self, *args: object) -> Tensor:
        """As `PrototypeLoss`, with temperatures fixed."""
        self.log_temperature.requires_grad_(False)
        return super().forward(*args)  # type: ignore[arg-type]
