"""`protomark split`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protomark.cli.options import numbers, write_json


def split(
    file: Annotated[Path, typer.Argument(metavar="MAP", help="An open map.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the parts.")],
    ids: Annotated[
        str,
        typer.Option(help="Ids at which a part begins, ascending, for example 100000,200000."),
    ] = "",
    parts: Annotated[
        int | None, typer.Option(min=1, help="Number of parts by id, of as many landmarks each.")
    ] = None,
    cell_size: Annotated[
        float | None,
        typer.Option(
            help="Edge of the cubes into which space is cut, in the unit of the positions; "
            "landmarks without a position are a part of their own."
        ),
    ] = None,
    sealed: Annotated[bool, typer.Option("--sealed", help="Seal the parts.")] = False,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the facts to this file.")
    ] = None,
) -> None:
    """Split a map by id or by space, for maps that are served in parts.

    The parts have no index. `protomark join` makes the same map of them again.
    """
    from protomark.evaluation.command import check_outputs
    from protomark.split import show, split_file

    check_outputs(json_file)
    boundaries = list(numbers("--ids", ids)) or None
    facts = split_file(file, output, boundaries, parts, cell_size, sealed)
    write_json(json_file, facts)
    show(facts)
