"""`protomark calibrate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protomark.cli.options import write_json


def calibrate(
    model: Annotated[Path, typer.Argument(help="Model file (.pme) that `protomark train` wrote.")],
    tracks: Annotated[
        list[Path], typer.Argument(help="Tracks files, one a sequence, of the model's descriptor.")
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Model file to write; by default MODEL itself."),
    ] = None,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads.")] = 1,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file.")
    ] = None,
) -> None:
    """Say in a model file which matches to accept, from frames whose landmarks are known.

    `protomark train` does this by itself. The probability that a match is right, given the
    distances to the two nearest landmarks, is fitted for each length of a code; the network stays
    the same, and so do maps made with it. docs/localization.md says more.
    """
    from protomark.calibration import calibrate_file, show
    from protomark.evaluation.command import check_outputs

    check_outputs(output or model, json_file)
    figures = calibrate_file(model, tracks, output or model, threads)
    write_json(json_file, {"figures": [f.as_dict() for f in figures]})
    show(figures)
