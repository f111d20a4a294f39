"""The command `protomark export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from protomark.cli.options import JsonFile


def export(
    scene: Annotated[
        Path,
        typer.Argument(
            metavar="SCENE",
            help="A folder of `protomark map`, tracks, a map of another program, or, for ply, a "
            "map file.",
        ),
    ],
    to: Annotated[
        Literal["ply", "colmap", "kapture", "nerfstudio", "orbslam3", "stella"],
        typer.Option(
            help="ply: landmarks for viewers. colmap: a model in sparse/0/. nerfstudio: "
            "transforms.json. kapture: a data set, of tracks. orbslam3: an atlas (.osa), smaller. "
            "stella: a map of stella_vslam (.msg), of ORB tracks."
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="File to write; for a model, new folder.")
    ],
    images: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the images, which give landmarks colours. Those of `map SECOND --into` "
            "are in its folder SECOND/."
        ),
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Write a scene for another program.

    protomark export kitchen --to colmap --images photos -o splats

    protomark export kitchen --to ply -o kitchen.ply
    """
    from protomark.cli.terminal import note_replaced, print_facts, write_json
    from protomark.exporters import FILES
    from protomark.exporters import export as export_scene
    from protomark.files import check_outputs

    file = output if to in FILES else None
    check_outputs(json_file, file, inputs=[scene, images])
    note_replaced(file)
    facts = export_scene(scene, output, to, images)
    write_json(json_file, facts)
    rows = [(name.replace("_", " "), f"{count:,}") for name, count in facts.items()]
    print_facts([*rows, ("written", str(output))])
