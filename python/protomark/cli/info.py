"""`protomark info`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protomark.cli.options import write_json


def info(
    file: Annotated[Path, typer.Argument(help="A map, an encoder or a tracks file.")],
    verify: Annotated[
        bool,
        typer.Option(
            "--verify", help="Check every checksum of a map or an encoder; tracks have none."
        ),
    ] = False,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the facts to this file.")
    ] = None,
) -> None:
    """Say what a file holds."""
    from protomark import verify_file
    from protomark.console import progress_console
    from protomark.info import describe, is_tracks, show

    with progress_console.status(f"Reading {file.name}"):
        facts = describe(file)
        if verify and is_tracks(file):
            facts["checksums"] = "none in a tracks file, which is checked whole whenever it is read"
        elif verify:
            verify_file(file)
            facts["checksums"] = "all right"
    write_json(json_file, facts)
    show(facts)
