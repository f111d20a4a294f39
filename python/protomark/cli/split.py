"""The command `protomark split`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def split(
    file: Annotated[Path, typer.Argument(metavar="MAP", help="A learning map.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the parts.")],
    ids: Annotated[
        str,
        typer.Option(help="Ids at which a part begins, ascending, for example 100000,200000."),
    ] = "",
    parts: Annotated[
        int | None, typer.Option(min=1, help="Number of parts by id, of equally many landmarks.")
    ] = None,
    cell_size: Annotated[
        float | None,
        typer.Option(
            help="Edge of the cubes that divide space, in the unit of the positions; landmarks "
            "without a position go into a part of their own."
        ),
    ] = None,
    sealed: Annotated[bool, typer.Option("--sealed", help="Seal the parts.")] = False,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the facts to this file.")
    ] = None,
) -> None:
    """Split a map by id or by space.

    The parts have no index. `protomark merge` makes the same map of them again.
    """
    from protomark.cli.terminal import (
        check_outputs,
        comma_separated_numbers,
        console,
        facts_table,
        progress_bar,
        write_json,
    )
    from protomark.maps.split import split_file

    check_outputs(json_file)
    boundaries = list(comma_separated_numbers("--ids", ids)) or None
    with progress_bar() as progress:
        facts = split_file(file, output, boundaries, parts, cell_size, sealed, progress)
    write_json(json_file, facts)
    rows = []
    for part in facts["parts"]:
        first, last = part["ids"]
        text = f"{part['landmarks']:,} landmarks, ids {first} to {last}, {part['bytes']:,} bytes"
        rows.append((Path(part["file"]).name, text))
    console.print(facts_table(rows))
