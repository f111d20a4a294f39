"""`protomark join`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protomark.cli.options import write_json


def join(
    maps: Annotated[
        list[Path],
        typer.Argument(metavar="MAP", help="Open maps of the same encoder, dim and look bits."),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Map file to write (.pmk).")],
    renumber: Annotated[
        bool,
        typer.Option(
            "--renumber",
            help="The maps have no landmark in common, whatever the ids say: those of each further "
            "map get new ids, above all before it.",
        ),
    ] = False,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the facts to this file.")
    ] = None,
) -> None:
    """Join maps that were built apart, exactly as if they had been one all along.

    Landmarks of one id are one landmark, and their observations are summed; the number of them is
    printed, as ids may be equal by accident. docs/sharing.md says more.
    """
    from protomark.evaluation.command import check_outputs
    from protomark.join import join_files, show

    check_outputs(output, json_file)
    facts = join_files(maps, output, renumber)
    write_json(json_file, facts)
    show(facts)
