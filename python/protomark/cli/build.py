"""`protomark build`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protomark.cli.options import write_json


def build(
    tracks: Annotated[Path, typer.Argument(help="Tracks file that `protomark tracks` wrote.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Map file to write (.pmk).")],
    encoder: Annotated[
        str | None,
        typer.Option(help="Name or file of the encoder; by default the descriptor's own."),
    ] = None,
    dim: Annotated[
        int | None, typer.Option(help="Dimensions of a prototype; by default all.")
    ] = None,
    min_observations: Annotated[
        int, typer.Option(help="Leave out landmarks with fewer observations.")
    ] = 2,
    sealed: Annotated[
        bool, typer.Option("--sealed", help="Write a sealed map: smaller, and only answers.")
    ] = False,
    code_bits: Annotated[
        int, typer.Option(help="Bits of a sealed prototype's number: 8, or 4 for half the bytes.")
    ] = 8,
    look_bits: Annotated[
        int,
        typer.Option(
            min=0,
            help="Signs of a code that tell several looks of a landmark apart, each with a "
            "prototype of its own: more precise, more bytes. 0 to 16, 0 for one prototype a "
            "landmark.",
        ),
    ] = 0,
    prototypes: Annotated[
        float | None,
        typer.Option(
            help="Largest number of prototypes that a landmark of a sealed map has on average: "
            "looks are joined until it fits. By default all are kept."
        ),
    ] = None,
    index: Annotated[
        bool,
        typer.Option(
            "--index",
            help="Learn coarse cells, for approximate search in large maps: at most 4 bytes a "
            "landmark more.",
        ),
    ] = False,
    upright: Annotated[
        bool,
        typer.Option(
            "--upright",
            help="For cameras that do not roll: encode the keypoints' angles and sizes, too.",
        ),
    ] = False,
    sized: Annotated[
        bool,
        typer.Option(
            "--sized",
            help="For places seen from like distances again: encode the keypoints' sizes, too.",
        ),
    ] = False,
    position_bits: Annotated[
        int,
        typer.Option(
            help="Bits of a sealed position's coordinate: 32, or 16 for half the bytes, exact to a "
            "131068th of the map's extent."
        ),
    ] = 32,
    frame: Annotated[
        str | None,
        typer.Option(
            help="Coordinate frame of the positions and their unit, for the map's metadata: 'ENU, "
            "metres', 'COLMAP, no scale', 'map (REP 105), metres'."
        ),
    ] = None,
    metadata: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=TEXT",
            help="What else the map shall say of itself; may be repeated. 'created' is now, or "
            "SOURCE_DATE_EPOCH where that is set.",
        ),
    ] = None,
    threads: Annotated[int, typer.Option(help="CPU threads.")] = 1,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the facts to this file.")
    ] = None,
) -> None:
    """Build a map from a tracks file: prototypes of each landmark, and its position."""
    from protomark.build import build_file
    from protomark.evaluation.command import check_outputs
    from protomark.info import describe, show
    from protomark.inputs import chosen
    from protomark.metadata import command_metadata

    check_outputs(output, json_file)
    texts = command_metadata(frame, metadata or [])
    build_file(
        tracks,
        output,
        encoder,
        dim,
        min_observations,
        sealed,
        threads,
        code_bits=code_bits,
        inputs=chosen(upright, sized),
        look_bits=look_bits,
        prototypes=prototypes,
        index=index,
        metadata=texts,
        position_bits=position_bits,
    )
    facts = describe(output)
    write_json(json_file, facts)
    show(facts)
