"""`protomark demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protomark.cli.options import write_json


def demo(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the maps and the picture.")
    ] = Path("demo"),
    encoder: Annotated[
        str | None,
        typer.Option(help="Name or file of an encoder; by default the descriptor's own."),
    ] = None,
    tracks: Annotated[
        Path | None, typer.Option(help="Another tracks file than the sample that ships.")
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file.")
    ] = None,
) -> None:
    """Build a map of the bundled sample, localize new keyframes in it, and compare."""
    from protomark.demo import run_demo, show
    from protomark.evaluation.command import check_outputs

    check_outputs(json_file)
    result = run_demo(output, tracks_path=tracks, encoder=encoder)
    write_json(json_file, result.as_dict())
    show(result)
