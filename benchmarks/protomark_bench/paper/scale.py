"""Scales of a reproduction, its networks, and the paper's figures."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Literal

Objective = Literal["triplet", "prototypical"]
Shape = Literal["funnel", "fat"]

OBJECTIVES: tuple[Objective, ...] = ("triplet", "prototypical")
SHAPES: tuple[Shape, ...] = ("funnel", "fat")
LAYERS = (2, 3, 4, 5)
DIMS = (8, 16, 32, 64)
TABLE_DIMS = (32, 16)
SEEDS = (0, 1, 2)

PAPER = (
    "Komorowski and Trzciński, *Aggregation of binary feature descriptors for compact scene model "
    "representation in large scale structure-from-motion applications*"
)
# From section "Network architectures evaluation", on the paper's test sequence.
PRECISION_BY_DIM = {8: 0.40, 16: 0.65, 32: 0.75, 64: 0.79}
# From the table of section "Final evaluation", by the names of our rows.
TABLE = {
    "unaggregated": 0.796,
    "prototypes-32": 0.750,
    "prototypes-16": 0.676,
    "majority": 0.671,
    "pca-16-float": 0.581,
    "random": 0.526,
}


@dataclass(frozen=True)
class Scale:
    """How long a reproduction trains, and on which sequences.

    Attributes:
        name: name for `--scale`.
        steps: limit on the batches of a training, None if plateaus end it.
        epoch: batches between two evaluations of the validation loss.
        patience: epochs without a lower validation loss after which the rate falls.
        small: whether to use only the smaller ones of the project's sequences.
    """

    name: str
    steps: int | None
    epoch: int
    patience: int
    small: bool = False


SCALES = {
    scale.name: scale
    for scale in (
        Scale("small", steps=600, epoch=50, patience=3, small=True),
        Scale("medium", steps=1500, epoch=100, patience=3),
        Scale("full", steps=None, epoch=250, patience=5),
    )
}


def find_scale(name: str) -> Scale:
    """The scale of this name.

    Raises:
        ValueError: there is no such scale.
    """
    if name not in SCALES:
        raise ValueError(f"--scale {name!r} is unknown: give {', '.join(SCALES)}")
    return SCALES[name]


@dataclass(frozen=True)
class Training:
    """One network to train.

    Attributes:
        objective: "triplet" or "prototypical".
        shape: "funnel" or "fat".
        layers: number of linear layers, including the last one, as in the paper.
        dim: units of the last layer.
        seed: seed of weights and batches.
    """

    objective: Objective
    shape: Shape
    layers: int
    dim: int = 16
    seed: int = 0

    def hidden(self, bits: int) -> tuple[int, ...]:
        """Units of all layers but the last, for descriptors of `bits` bits.

        'fat': all are as wide as the input. 'funnel': the first is as wide as the input, each
        further one half as wide as the previous one. With two layers both are the same network.
        """
        if self.shape == "fat":
            return (bits,) * (self.layers - 1)
        return tuple(bits >> i for i in range(self.layers - 1))

    @property
    def label(self) -> str:
        """The network and the objective, in words."""
        shape = "" if self.layers == 2 else f"{self.shape}, "
        return f"{shape}{self.layers} layers, {self.objective}"

    def like(self, dim: int, seed: int = 0) -> Training:
        """The same network and objective with another last layer or seed."""
        return Training(self.objective, self.shape, self.layers, dim, seed)


# The best network on the paper's validation sequence, which it used on its test sequence.
PAPER_PICK = Training("triplet", "funnel", 3)


def depth_trainings() -> list[Training]:
    """Every shape, depth and objective at 16 outputs."""
    return [
        Training(objective, shape, layers)
        for objective, shape, layers in product(OBJECTIVES, SHAPES, LAYERS)
    ]


def measured_trainings(pick: Training) -> list[Training]:
    """Networks to measure on the test sequences: every dimension once, the table's at each seed."""
    by_dim = [pick.like(dim) for dim in DIMS]
    by_seed = [pick.like(dim, seed) for dim, seed in product(TABLE_DIMS, SEEDS)]
    return list(dict.fromkeys(by_dim + by_seed))
