"""The command `protomark calibrate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protomark.cli.options import JsonFile, Threads, TracksFiles


def calibrate(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="Model of `protomark train`.")],
    tracks: TracksFiles,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Model file to write; by default MODEL itself."),
    ] = None,
    threads: Threads = 1,
    json_file: JsonFile = None,
) -> None:
    """Fit how likely an encoder's matches are right.

    Reads a model and tracks, whose landmarks are known. Fits, for each code length, and for
    mean and tuned prototypes, the probability that a match is right, given the distances to the two
    nearest landmarks, and writes the fit into the model file. Codes and maps stay the same.
    `protomark train` does this by itself.

    protomark calibrate freak.pme tracks/*.freak.safetensors
    """
    from protomark import Encoder
    from protomark.cli.terminal import (
        console,
        note_replaced,
        progress_bar,
        say,
        table_of,
        write_json,
    )
    from protomark.files import check_outputs
    from protomark.matching import MIN_PROBABILITY
    from protomark.training.match_calibration import calibrate as fit

    check_outputs(output or model, json_file, inputs=tracks)
    note_replaced(output)
    with progress_bar() as progress:
        encoder, quality = fit(Encoder.load(model), tracks, threads, progress)
    encoder.save(output or model)
    write_json(json_file, {"figures": [vars(one) for one in quality]})
    table = table_of(
        "sequence", "dim", "prototypes", "right of all", "precision", "expected", "recall"
    )
    for one in quality:
        shares = (one.right, one.precision, one.expected, one.recall)
        kind = "tuned" if one.tuned else "mean"
        table.add_row(one.sequence, str(one.dim), kind, *(f"{share:.3f}" for share in shares))
    console.print(table)
    say(
        f"Matches with a probability of {MIN_PROBABILITY:g} or more. Each sequence is measured "
        "with a fit to the others."
    )
