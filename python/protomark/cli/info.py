"""`protomark info`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protomark.cli.options import write_json


def info(
    file: Annotated[Path, typer.Argument(help="A map, an encoder or a tracks file.")],
    verify: Annotated[
        bool, typer.Option("--verify", help="Check every checksum of a map or an encoder.")
    ] = False,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the facts to this file.")
    ] = None,
) -> None:
    """Say what a file holds."""
    from protomark import verify_file
    from protomark.console import progress_console
    from protomark.info import describe, show

    with progress_console.status(f"Reading {file.name}"):
        facts = describe(file)
        if verify and facts["kind"] != "tracks":
            verify_file(file)
            facts["checksums"] = "all right"
    write_json(json_file, facts)
    show(facts)
