"""All figures of a reproduction."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from protomark.reproduce.paper import TABLE
from protomark.reproduce.training import PAPER_PICK, Objective, Shape, Training

FORMAT = "protomark-reproduction"
VERSION = 1


@dataclass(frozen=True)
class DepthPoint:
    """One network of the comparison of architectures.

    Attributes:
        training: the network and its objective.
        hidden: units of all layers but the last.
        precision: on validation.
        validation_loss: the lowest, of the training's own objective.
        best_step: steps after which it was found; these weights were kept.
        steps: steps in all.
        seconds: that the training took.
    """

    training: Training
    hidden: tuple[int, ...]
    precision: float
    validation_loss: float
    best_step: int
    steps: int
    seconds: float

    @property
    def was_improving(self) -> bool:
        """Whether the last look at the validation loss found the lowest one."""
        return self.best_step == self.steps


@dataclass(frozen=True)
class Curve:
    """Precision on the test sequences against dimension, one seed.

    Attributes:
        training: the network and its objective, at any dimension.
        precision: dimension -> sequence -> precision.
    """

    training: Training
    precision: dict[int, dict[str, float]]

    def mean(self, dim: int) -> float:
        """Mean over the sequences."""
        return float(np.mean(list(self.precision[dim].values())))


@dataclass(frozen=True)
class Row:
    """One method of the table.

    Attributes:
        name: as in `paper.TABLE` where the paper has it.
        label: what the table says.
        bytes_per_landmark: mean over the sequences, with the count of observations.
        precision: sequence -> one number a seed.
    """

    name: str
    label: str
    bytes_per_landmark: float
    precision: dict[str, list[float]]

    @property
    def by_seed(self) -> list[float]:
        """Mean over the sequences at each seed."""
        return [float(v) for v in np.mean(list(self.precision.values()), axis=0)]

    @property
    def mean(self) -> float:
        """Mean over sequences and seeds."""
        return float(np.mean(self.by_seed))

    @property
    def spread(self) -> float:
        """Standard deviation over seeds of the mean over sequences."""
        return float(np.std(self.by_seed, ddof=1))

    @property
    def paper(self) -> float | None:
        """What the paper has for this method."""
        return TABLE.get(self.name)


@dataclass(frozen=True)
class SequenceFacts:
    """What a sequence holds, and what it was used for."""

    name: str
    role: str
    keyframes: int
    landmarks: int
    observations: int


@dataclass(frozen=True)
class Results:
    """Everything that the report is made from.

    Attributes:
        scale: name of the scale.
        max_steps: limit of a training, None where plateaus end it.
        descriptor: its name.
        bits: its length.
        sequences: in the order training, validation, test.
        depth: the comparison of architectures on validation.
        curves: precision against dimension: the paper's network, then the best one on validation
            if it is another.
        rows: the table.
        conditions: name -> value, what else one has to know to run it again.
    """

    scale: str
    max_steps: int | None
    descriptor: str
    bits: int
    sequences: list[SequenceFacts]
    depth: list[DepthPoint]
    curves: list[Curve]
    rows: list[Row]
    conditions: dict[str, str]

    @property
    def winner(self) -> DepthPoint:
        """The best network on validation."""
        return best(self.depth)

    @property
    def networks(self) -> list[DepthPoint]:
        """The comparison without what is in it twice: with two layers, fat and funnel are one."""
        return list({(p.training.objective, p.hidden): p for p in reversed(self.depth)}.values())[
            ::-1
        ]

    @property
    def paper_pick(self) -> DepthPoint:
        """The network that the paper found best."""
        return self.point("triplet", "funnel", PAPER_PICK.layers)

    def point(self, objective: Objective, shape: Shape, layers: int) -> DepthPoint:
        """One network of the comparison."""
        wanted = Training(objective, shape, layers)
        return next(point for point in self.depth if point.training == wanted)

    def row(self, name: str) -> Row:
        """The row of this name."""
        return next(row for row in self.rows if row.name == name)

    def ratios(self, row: Row) -> list[float]:
        """Precision as a share of the unaggregated one on the same queries, at each seed."""
        whole = self.row("unaggregated").by_seed
        return [mine / max(all_, 1e-9) for mine, all_ in zip(row.by_seed, whole, strict=True)]

    def ratio(self, row: Row) -> float:
        """Mean of the ratios over seeds."""
        return float(np.mean(self.ratios(row)))

    def ratio_spread(self, row: Row) -> float:
        """Standard deviation of the ratios over seeds."""
        return float(np.std(self.ratios(row), ddof=1))

    @property
    def curves_unaggregated(self) -> float:
        """Unaggregated precision on the queries of the curves, which have the first seed."""
        return self.row("unaggregated").by_seed[0]

    def names(self, role: str) -> list[str]:
        """Names of the sequences of a role."""
        return [s.name for s in self.sequences if s.role == role]

    def as_dict(self) -> dict[str, Any]:
        """JSON values; means, spreads and ratios are added."""
        values = asdict(self)
        for row, made in zip(self.rows, values["rows"], strict=True):
            made.update(
                mean=row.mean,
                spread=row.spread,
                of_unaggregated=self.ratio(row),
                of_unaggregated_spread=self.ratio_spread(row),
                paper=row.paper,
            )
        for curve, made in zip(self.curves, values["curves"], strict=True):
            made["mean"] = {dim: curve.mean(dim) for dim in curve.precision}
        return {"format": FORMAT, "version": VERSION, **values}


def best(points: list[DepthPoint]) -> DepthPoint:
    """The point of the highest precision, the first one on a tie."""
    return max(points, key=lambda point: point.precision)
