"""The command `protomark merge`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protomark.cli.options import JsonFile


def merge(
    maps: Annotated[
        list[Path],
        typer.Argument(
            metavar="MAP",
            help="Learning maps of the same encoder, dimensions and appearance bits.",
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Map file to write (.pmk).")],
    renumber: Annotated[
        bool,
        typer.Option(
            "--renumber",
            help="The maps have no landmark in common, whatever the ids say: landmarks of each "
            "further map get new ids above all earlier ones. Positions must be of one world.",
        ),
    ] = False,
    json_file: JsonFile = None,
) -> None:
    """Merge maps that were built apart, exactly.

    Reads learning maps and writes the map that would have been built from all their observations
    together. Landmarks with the same id are one landmark, and their observations are summed; maps
    in which these do not look alike, or lie elsewhere, are refused.

    protomark merge monday.pmk tuesday.pmk -o week.pmk
    """
    from protomark.cli.terminal import print_facts, progress_bar, write_json
    from protomark.files import check_outputs
    from protomark.maps.merge import merge_files

    check_outputs(output, json_file, inputs=maps)
    with progress_bar() as progress:
        facts = merge_files(maps, output, renumber, progress)
    write_json(json_file, facts)
    rows = []
    for i, one in enumerate(facts["inputs"]):
        shared = f", {one['in_common']:,} of them in an earlier map" if i else ""
        rows.append((Path(one["file"]).name, f"{one['landmarks']:,} landmarks{shared}"))
    rows.append(("merged", f"{facts['landmarks']:,} landmarks, {facts['bytes']:,} bytes"))
    print_facts(rows)
