"""The card beside a model: its data, training and precision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from protomark.features.descriptors import InputKind
from protomark.report import markdown_table
from protomark.training.data import TrainingSource

_DATA_HEAD = ("sequence", "used for", "keyframes", "landmarks", "observations", "licence")
_PRECISION_HEAD = (
    *("sequence", "splits", "unaggregated", "medoid", "majority", "dim", "bytes per landmark"),
    *("float", "integer", "ratio to unaggregated"),
)


@dataclass(frozen=True)
class SequencePrecision:
    """Precision on one sequence, averaged over splits."""

    sequence: str
    role: str  # "validation" or "report"
    seeds: int  # number of splits
    unaggregated: float  # precision of all raw descriptors
    medoid: float  # precision of one descriptor per landmark, the one closest to the others
    # Precision of the mean of each landmark's descriptors, rounded to their type.
    majority: float
    float_precision: dict[int, float]  # precision of the float network, by code length
    # Precision of the integer encoder with int8 prototypes, by code length.
    integer_precision: dict[int, float]


@dataclass(frozen=True)
class EncoderCard:
    """The content of a card, which `protomark train --json` writes, too."""

    name: str
    descriptor: str  # descriptor that it encodes
    bits: int
    input: InputKind  # what the descriptor is
    widths: list[int]  # units per layer, including input and output
    dims: list[int]  # prefixes that maps may use alone
    bytes: int  # size of the model file
    licence: str  # licence of the weights
    sources: list[TrainingSource]  # training sequences
    validation: list[TrainingSource]  # validation sequences
    command: str  # command that trains the encoder again
    seconds: float  # duration of the training
    machine: str  # processor or accelerator, threads and arithmetic of the training
    steps: int  # number of batches
    best_step: int  # step whose weights the encoder has
    figures: list[SequencePrecision]  # precision by sequence
    # (step, loss, mean validation precision) of each validation.
    history: list[tuple[int, float, float]] = field(default_factory=list)
    plot: str = ""  # file name of the picture of the training, beside the card, or ""
    calibrated_on: str = ""  # sequences that the match calibration was fitted to, or ""

    @property
    def multiply_adds(self) -> int:
        """Multiply-adds for one descriptor."""
        return sum(a * b for a, b in pairwise(self.widths))

    def markdown(self) -> str:
        """The card as Markdown."""
        dims = ", ".join(map(str, self.dims))
        size = f"{self.bits} bits"
        if self.input != "bits":
            size = f"{self.widths[0]} numbers ({self.input})"
        lines = [
            f"# Encoder `{self.name}`",
            "",
            f"Turns {self.descriptor} descriptors of {size} into int8 codes of "
            f"{dims} numbers (each shorter code is the start of the longer one).",
            "",
            f"- network: {'-'.join(map(str, self.widths))}, SELU, int8 weights; "
            f"{self.multiply_adds:,} multiply-adds per descriptor",
            f"- file: {self.bytes:,} bytes",
            f"- licence: {self.licence or 'none stated'}",
            f"- trained in {_duration(self.seconds)} on {self.machine}; {self.steps} steps, "
            f"the weights of step {self.best_step} kept",
            "- codebooks: words of 2 and 3 numbers, learned on the training sequences' prototypes",
            f"- match calibration: fitted to {self.calibrated_on or 'nothing'} "
            "(`protomark calibrate`)",
            "",
            "Train it again:",
            "",
            "```",
            self.command,
            "```",
            "",
            "## Data",
            "",
        ]
        data = []
        for role, sources in (("training", self.sources), ("validation", self.validation)):
            for s in sources:
                counts = map(str, (s.keyframes, s.landmarks, s.observations))
                data.append([s.name, role, *counts, s.licence or "not stated"])
        lines += [
            markdown_table(_DATA_HEAD, data, left=len(_DATA_HEAD)),
            "## Precision",
            "",
            "Share of queries whose nearest prototype is their own landmark's: 90 % of the "
            "keyframes build the map, the others query it; mean of the splits. *Unaggregated*: all "
            "raw descriptors of the landmarks; *medoid*, *majority*: one descriptor per "
            "landmark; *float*: the network before rounding, *integer*: the encoder in this file "
            "with int8 prototypes.",
            "",
            markdown_table(_PRECISION_HEAD, self.figure_rows()),
        ]
        if self.plot:
            lines += ["## Training", "", f"![loss and validation precision]({self.plot})", ""]
        return "\n".join(lines)

    def figure_rows(self) -> list[list[str]]:
        """The precision on each sequence by code length, as text for a table."""
        return [
            [
                f"{f.sequence} ({f.role})",
                str(f.seeds),
                *(f"{share:.4f}" for share in (f.unaggregated, f.medoid, f.majority)),
                str(d),
                str(d + 1),
                f"{f.float_precision[d]:.4f}",
                f"{f.integer_precision[d]:.4f}",
                f"{f.integer_precision[d] / max(f.unaggregated, 1e-9):.3f}",
            ]
            for f in self.figures
            for d in self.dims
        ]


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes else f"{seconds:.0f} s"


def describe_data(sources: Sequence[TrainingSource]) -> str:
    """The sequences and their licences, in one line for the model file."""
    return "; ".join(f"{s.name} ({s.licence})" if s.licence else s.name for s in sources)
