"""Which trainings there are: a network, an objective and a seed each."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, product
from typing import Literal

Objective = Literal["triplet", "prototypical"]
Shape = Literal["funnel", "fat"]

OBJECTIVES: tuple[Objective, ...] = ("triplet", "prototypical")
SHAPES: tuple[Shape, ...] = ("funnel", "fat")
LAYERS = (2, 3, 4, 5)
DIMS = (8, 16, 32, 64)
DIM = 16
TABLE_DIMS = (32, 16)
SEEDS = (0, 1, 2)


@dataclass(frozen=True)
class Training:
    """One network to train.

    Attributes:
        objective: "triplet" or "prototypical".
        shape: "funnel" or "fat".
        layers: linear layers, the last one included, as the paper counts them.
        dim: units of the last layer.
        seed: of weights and batches.
    """

    objective: Objective
    shape: Shape
    layers: int
    dim: int = DIM
    seed: int = 0

    def hidden(self, bits: int) -> tuple[int, ...]:
        """Units of all layers but the last, for descriptors of `bits` bits.

        'fat': all as wide as the input. 'funnel': the first as wide as the input, each next one
        half as wide as the one before. With two layers both are the same network.
        """
        if self.shape == "fat":
            return (bits,) * (self.layers - 1)
        return tuple(bits >> i for i in range(self.layers - 1))

    def multiply_adds(self, bits: int) -> int:
        """Multiply-adds of the network for one descriptor."""
        widths = (bits, *self.hidden(bits), self.dim)
        return sum(a * b for a, b in pairwise(widths))

    @property
    def label(self) -> str:
        """The network and the objective, in words."""
        shape = "" if self.layers == 2 else f"{self.shape}, "
        return f"{shape}{self.layers} layers, {self.objective}"

    def like(self, dim: int, seed: int = 0) -> Training:
        """The same network and objective with another last layer or seed."""
        return Training(self.objective, self.shape, self.layers, dim, seed)


PAPER_PICK = Training("triplet", "funnel", 3)
"""What the paper found best on its validation sequence, and used on its test sequence."""


def depth_trainings() -> list[Training]:
    """Every shape, depth and objective at 16 outputs."""
    return [
        Training(objective, shape, layers)
        for objective, shape, layers in product(OBJECTIVES, SHAPES, LAYERS)
    ]


def measured_trainings(pick: Training) -> list[Training]:
    """What the test sequences are measured with: every dimension once, the table's three times."""
    by_dim = [pick.like(dim) for dim in DIMS]
    by_seed = [pick.like(dim, seed) for dim, seed in product(TABLE_DIMS, SEEDS)]
    return list(dict.fromkeys(by_dim + by_seed))
