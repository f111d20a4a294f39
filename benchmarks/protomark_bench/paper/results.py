"""Results of a reproduction, as JSON and as a page beside the paper's numbers."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from protomark_bench import plot
from protomark_bench.paper.scale import (
    DIMS,
    LAYERS,
    OBJECTIVES,
    PAPER,
    PRECISION_BY_DIM,
    SEEDS,
    SHAPES,
    TABLE,
    Training,
)
from protomark_bench.report import Part, Report, ReportTable, facts, load_json, number, picture

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAME, FORMAT, VERSION = "reproduction", "protomark-reproduction", 1
_COLORS = {"triplet": plot.AMBER, "prototypical": plot.TEAL}


@dataclass(frozen=True)
class DepthPoint:
    """One network of the comparison of architectures.

    Attributes:
        training: the network and its objective.
        hidden: units of all layers but the last.
        precision: precision on validation.
        validation_loss: lowest validation loss of the training's objective.
        best_step: step with that loss, whose weights are used.
        steps: number of steps.
        seconds: duration of the training.
    """

    training: Training
    hidden: tuple[int, ...]
    precision: float
    validation_loss: float
    best_step: int
    steps: int
    seconds: float


@dataclass(frozen=True)
class DimensionCurve:
    """Precision on the test sequences against dimension, one seed.

    Attributes:
        training: the network and its objective, at any dimension.
        precision: precision by dimension and sequence.
    """

    training: Training
    precision: dict[int, dict[str, float]]

    def mean(self, dim: int) -> float:
        """Mean over the sequences."""
        return float(np.mean(list(self.precision[dim].values())))


@dataclass(frozen=True)
class MethodRow:
    """One method of the table.

    Attributes:
        name: its name, that of `scale.TABLE` if the paper has it.
        label: its name in the table.
        bytes_per_landmark: mean over the sequences, including the count of observations.
        precision: one number per seed, by sequence.
    """

    name: str
    label: str
    bytes_per_landmark: float
    precision: dict[str, list[float]]

    @property
    def by_seed(self) -> list[float]:
        """Mean over the sequences at each seed."""
        return [float(v) for v in np.mean(list(self.precision.values()), axis=0)]


@dataclass(frozen=True)
class SequenceSize:
    """The size of a sequence, and its role: training, validation or test."""

    name: str
    role: str
    keyframes: int
    landmarks: int
    observations: int


@dataclass(frozen=True)
class PaperResults:
    """The content of the report.

    Attributes:
        scale: name of the scale.
        max_steps: limit on the steps of a training, None if plateaus end it.
        descriptor: name of the descriptor.
        bits: length of the descriptor.
        sequences: sizes of training, validation and test sequences.
        depth: comparison of architectures on validation.
        curves: precision against dimension of the paper's network, and of the best one on
            validation if it is another.
        rows: rows of the table.
        conditions: conditions of the run, by name.
    """

    scale: str
    max_steps: int | None
    descriptor: str
    bits: int
    sequences: list[SequenceSize]
    depth: list[DepthPoint]
    curves: list[DimensionCurve]
    rows: list[MethodRow]
    conditions: dict[str, str]

    @classmethod
    def load(cls, path: Path) -> PaperResults:
        """Reads the JSON of a report.

        Raises:
            FileNotFoundError, ValueError: the file is missing or holds no such results.
        """
        values = load_json(path, FORMAT)
        values["sequences"] = [SequenceSize(**s) for s in values["sequences"]]
        for point in values["depth"]:
            point.update(training=Training(**point["training"]), hidden=tuple(point["hidden"]))
        values["depth"] = [DepthPoint(**point) for point in values["depth"]]
        values["curves"] = [
            DimensionCurve(
                Training(**curve["training"]), {int(d): p for d, p in curve["precision"].items()}
            )
            for curve in values["curves"]
        ]
        values["rows"] = [
            MethodRow(r["name"], r["label"], r["bytes_per_landmark"], r["precision"])
            for r in values["rows"]
        ]
        return cls(**values)

    def as_dict(self) -> dict[str, Any]:
        """The results as JSON values, with shares of the unaggregated precision and the paper's."""
        values = asdict(self)
        for row, entry in zip(self.rows, values["rows"], strict=True):
            entry.update(
                mean=_mean(row.by_seed),
                of_unaggregated=_mean(self.shares(row)),
                paper=TABLE.get(row.name),
            )
        return {"format": FORMAT, "version": VERSION, **values}

    def names(self, role: str) -> list[str]:
        """Names of the sequences of a role."""
        return [s.name for s in self.sequences if s.role == role]

    def precision(self, objective: str, shape: str, layers: int) -> float:
        """Precision on validation of a network of the comparison."""
        network = (objective, shape, layers)
        return next(
            p.precision
            for p in self.depth
            if (p.training.objective, p.training.shape, p.training.layers) == network
        )

    @property
    def unaggregated(self) -> list[float]:
        """Precision of the unaggregated map at each seed, of which the curves use the first."""
        return next(row for row in self.rows if row.name == "unaggregated").by_seed

    def shares(self, row: MethodRow) -> list[float]:
        """Precision at each seed as a share of the unaggregated one on the same queries."""
        return [a / max(b, 1e-9) for a, b in zip(row.by_seed, self.unaggregated, strict=True)]

    def report(self) -> Report:
        """The report: page, plots and JSON."""
        plots = {"depth": draw_depth(self), "dimension": draw_dimension(self)}
        title = f"Mean of {', '.join(self.names('test'))}"
        methods = self._methods().rich(title)
        return Report(NAME, "protomark reproduce", self.as_dict(), self._parts(), plots, [methods])

    def _parts(self) -> list[Part]:
        limit = (
            f"at most {self.max_steps:,} steps per training"
            if self.max_steps
            else "trained until the validation loss stagnates for the third time"
        )
        return [
            f"# The paper reproduced, scale `{self.scale}`",
            f"{PAPER}, run again by `protomark reproduce` on other sequences: "
            f"{self.descriptor.upper()} with {self.bits} bits, {limit}. The paper's numbers stand "
            "beside ours. As the sequences differ, compare the order of rows and their share of "
            "the unaggregated precision.",
            "## Networks",
            f"Precision on validation ({', '.join(self.names('validation'))}), 16 outputs, one "
            "seed. Two layers are the same network in both shapes. The paper shows a figure "
            "without numbers.",
            picture(NAME, "depth", "Precision against depth"),
            self._depth(),
            "<details><summary>All trainings of this comparison</summary>",
            self._trainings(),
            "Losses of different objectives cannot be compared.\n\n</details>",
            "## Dimensions",
            f"Precision on the test sequences ({', '.join(self.names('test'))}), mean, one seed.",
            picture(NAME, "dimension", "Precision against dimension"),
            self._dimensions(),
            "## Methods",
            f"Mean over the test sequences; ± is the standard deviation over {len(SEEDS)} seeds, "
            "each of which decides the training and the split. Prototypes and PCA are float32, as "
            "in the paper. Bytes count all that matching needs per landmark. *Best on validation* "
            "is the best network of the comparison above. *Protomark* is the encoder that ships, "
            "with int8 prototypes: this project's own, not the paper's.",
            self._methods(),
            "Precision by sequence, mean over seeds:",
            self._by_sequence(),
            "## Conditions",
            self._sizes(),
            facts(self.conditions),
        ]

    def _depth(self) -> ReportTable:
        rows = [
            [
                f"{shape}, {objective}",
                *(f"{self.precision(objective, shape, n):.3f}" for n in LAYERS),
            ]
            for objective in OBJECTIVES
            for shape in SHAPES
        ]
        return ReportTable(["network and loss", *(f"{n} layers" for n in LAYERS)], rows)

    def _trainings(self) -> ReportTable:
        # With two layers fat and funnel are one network.
        points = {(p.training.objective, p.hidden): p for p in reversed(self.depth)}.values()
        rows = [
            [
                p.training.label,
                "-".join(str(units) for units in (*p.hidden, p.training.dim)),
                f"{p.validation_loss:.4f}",
                f"{p.best_step:,}",
                f"{p.steps:,}",
                f"{p.seconds:,.0f}",
            ]
            for p in reversed(points)
        ]
        heads = ["training", "units", "validation loss", "at step", "steps", "seconds"]
        return ReportTable(heads, rows, words=2)

    def _dimensions(self) -> ReportTable:
        named = {
            f"ours: {curve.training.label}": ([curve.mean(d) for d in DIMS], self.unaggregated[0])
            for curve in self.curves
        }
        named["the paper"] = ([PRECISION_BY_DIM[d] for d in DIMS], TABLE["unaggregated"])
        rows = []
        for name, (values, whole) in named.items():
            rows.append([name, *(f"{value:.3f}" for value in values)])
            rows.append(["… of unaggregated", *(f"{value / whole:.3f}" for value in values)])
        return ReportTable(["precision at", *(str(d) for d in DIMS)], rows)

    def _methods(self) -> ReportTable:
        rows = []
        for row in self.rows:
            paper = TABLE.get(row.name)
            rows.append(
                [
                    row.label,
                    f"{row.bytes_per_landmark:,.0f}",
                    _with_spread(row.by_seed),
                    _with_spread(self.shares(row)),
                    number(paper),
                    number(None if paper is None else paper / TABLE["unaggregated"]),
                ]
            )
        heads = ["method", "bytes", "ours", "of unaggregated", "paper", "of unaggregated"]
        return ReportTable(heads, rows)

    def _by_sequence(self) -> ReportTable:
        names = self.names("test")
        rows = [[r.label, *(f"{_mean(r.precision[n]):.3f}" for n in names)] for r in self.rows]
        return ReportTable(["method", *names], rows)

    def _sizes(self) -> ReportTable:
        rows = [
            [s.name, s.role, f"{s.keyframes:,}", f"{s.landmarks:,}", f"{s.observations:,}"]
            for s in self.sequences
        ]
        heads = ["sequence", "used for", "keyframes", "landmarks", "observations"]
        return ReportTable(heads, rows, words=2)


def draw_depth(results: PaperResults) -> Figure:
    """Draw precision on validation against depth, for both shapes and objectives."""
    series = [
        plot.Series(
            f"{shape}, {objective}",
            LAYERS,
            [results.precision(objective, shape, n) for n in LAYERS],
            _COLORS[objective],
            "--s" if shape == "fat" else "-o",
            hollow=shape == "fat",
        )
        for objective in OBJECTIVES
        for shape in SHAPES
    ]
    y = f"precision on {', '.join(results.names('validation'))}"
    ticks = {float(n): str(n) for n in LAYERS}
    title = "Precision against depth, 16 outputs"
    return plot.draw_lines([plot.Panel(title, "layers", y, series, ticks)])


def draw_dimension(results: PaperResults) -> Figure:
    """Draw precision on test against dimension, absolute and as a share of the unaggregated."""
    whole, paper = results.unaggregated[0], TABLE["unaggregated"]
    panels = []
    for title, y, ours, theirs, levels in (
        (
            "Precision against dimension",
            "precision, mean of test sequences",
            1.0,
            1.0,
            [
                (whole, "unaggregated, ours", plot.INK),
                (paper, "unaggregated, the paper's", plot.MUTED),
            ],
        ),
        ("", "share of the unaggregated precision", whole, paper, [(1.0, "", plot.INK)]),
    ):
        series = [
            plot.Series(
                f"ours: {curve.training.label}",
                DIMS,
                [curve.mean(dim) / ours for dim in DIMS],
                _COLORS[curve.training.objective],
                hollow=i > 0,
            )
            for i, curve in enumerate(results.curves)
        ]
        values = [PRECISION_BY_DIM[dim] / theirs for dim in DIMS]
        series.append(plot.Series("the paper's figures", DIMS, values, plot.MUTED, ":D"))
        ticks = {float(dim): str(dim) for dim in DIMS}
        x = "dimensions of a prototype"
        panels.append(plot.Panel(title, x, y, series, ticks, log="2", levels=levels))
    return plot.draw_lines(panels)


def _mean(values: list[float]) -> float:
    return float(np.mean(values))


def _with_spread(by_seed: list[float]) -> str:
    return f"{_mean(by_seed):.3f} ± {float(np.std(by_seed, ddof=1)):.3f}"
