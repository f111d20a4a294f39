"""The command `protomark crop`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protomark.cli.options import JsonFile


def crop(
    scene: Annotated[
        Path, typer.Argument(metavar="MAP", help="A learning map, or a folder of `protomark map`.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Map file to write (.pmk).")],
    box: Annotated[
        str,
        typer.Option(
            metavar="X,Y,Z,X,Y,Z", help="Keep landmarks from the lowest to the highest corner."
        ),
    ] = "",
    near: Annotated[
        str,
        typer.Option(metavar="X,Y,Z,R", help="Keep landmarks within a distance of a point."),
    ] = "",
    images: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Keep landmarks that images see, by name in a folder of `protomark map`, or by a "
            "pattern such as 'hall/*'; may be repeated.",
        ),
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Keep the part of a map that is in a box, near a point, or seen in some images.

    Reads a learning map and writes the landmarks there as one, which may be sealed or merged.

    protomark crop kitchen --near 1.5,0,2,4 -o table.pmk
    """
    from protomark.cli.terminal import (
        decimal_numbers,
        note_outdated,
        note_replaced,
        print_facts,
        write_json,
    )
    from protomark.files import SCENE_MAP, check_outputs
    from protomark.maps.split import crop_file

    check_outputs(json_file, inputs=[scene, scene / SCENE_MAP], maps=[output])
    note_replaced(output)
    corners, ball = decimal_numbers("--box", box), decimal_numbers("--near", near)
    facts = crop_file(scene, output, corners, ball, images or None)
    write_json(json_file, facts)
    rows = [("kept", f"{facts['kept']:,} of {facts['landmarks']:,} landmarks")]
    if facts["without_position"]:
        rows.append(("left out", f"{facts['without_position']:,} landmarks without a position"))
    print_facts([*rows, ("written", f"{facts['bytes']:,} bytes")])
    note_outdated(output)
