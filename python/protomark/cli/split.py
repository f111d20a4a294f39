"""The command `protomark split`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protomark.cli.options import JsonFile


def split(
    file: Annotated[Path, typer.Argument(metavar="MAP", help="A learning map.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the parts.")],
    ids: Annotated[
        str,
        typer.Option(
            metavar="ID,ID,...",
            help="Split by id, before each of these, for example 100000,200000.",
        ),
    ] = "",
    parts: Annotated[
        int | None,
        typer.Option(min=1, help="Split by id into so many parts of equally many landmarks."),
    ] = None,
    cell_size: Annotated[
        float | None,
        typer.Option(
            help="Split by space into cubes with edges of this length, in the unit of the "
            "positions; landmarks without a position get a part of their own."
        ),
    ] = None,
    sealed: Annotated[bool, typer.Option("--sealed", help="Seal the parts.")] = False,
    json_file: JsonFile = None,
) -> None:
    """Split a map by id or by space.

    Reads a learning map and writes one map file per part, without an index. `protomark merge`
    makes the same map of the parts again.

    protomark split city.pmk --cell-size 50 --sealed -o tiles/
    """
    from protomark.cli.terminal import (
        comma_separated_numbers,
        note,
        print_facts,
        progress_bar,
        write_json,
    )
    from protomark.files import check_outputs
    from protomark.maps.split import split_file

    check_outputs(json_file, inputs=[file], folder=output)
    boundaries = list(comma_separated_numbers("--ids", ids)) or None
    with progress_bar() as progress:
        facts = split_file(file, output, boundaries, parts, cell_size, sealed, progress)
    write_json(json_file, facts)
    if replaced := facts["replaced"]:
        note(f"{len(replaced)} files were replaced, such as {replaced[0]}")
    if removed := facts["removed"]:
        note(f"{len(removed)} files of an earlier split were removed, such as {removed[0]}")
    rows = []
    for part in facts["parts"]:
        first, last = part["ids"]
        text = f"{part['landmarks']:,} landmarks, ids {first} to {last}, {part['bytes']:,} bytes"
        rows.append((Path(part["file"]).name, text))
    print_facts(rows)
