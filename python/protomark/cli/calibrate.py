"""The command `protomark calibrate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


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
    """Fit how likely matches are right, for an encoder.

    From frames whose landmarks are known.
    `protomark train` does this by itself. The probability that a match is right, given the
    distances to the two nearest landmarks, is fitted for each code length and written into the
    model file; the network stays the same, and so do maps made with it. docs/localization.md says
    more.
    """
    from protomark import Encoder
    from protomark.cli.terminal import (
        check_outputs,
        console,
        progress_bar,
        say,
        table_of,
        write_json,
    )
    from protomark.matching import MIN_PROBABILITY
    from protomark.training.match_calibration import calibrate as fit

    check_outputs(output or model, json_file)
    with progress_bar() as progress:
        encoder, quality = fit(Encoder.load(model), tracks, threads, progress)
    encoder.save(output or model)
    write_json(json_file, {"figures": [one.as_dict() for one in quality]})
    table = table_of("sequence", "dim", "right of all", "precision", "expected", "recall")
    for one in quality:
        shares = (one.right, one.precision, one.expected, one.recall)
        table.add_row(one.sequence, str(one.dim), *(f"{share:.3f}" for share in shares))
    console.print(table)
    say(
        f"Matches with a probability of {MIN_PROBABILITY:g} or more; each sequence by a fit to the "
        "others."
    )
