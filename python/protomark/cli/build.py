"""The command `protomark build`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


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
        bool,
        typer.Option("--sealed", help="Write a sealed map, which is smaller and only answers."),
    ] = False,
    bytes_per_landmark: Annotated[
        float | None,
        typer.Option(
            "--bytes",
            help="Most bytes that a sealed map spends on a landmark's prototypes on average, for "
            "example 33. By default nothing is lost.",
        ),
    ] = None,
    appearance_bits: Annotated[
        int,
        typer.Option(
            min=0,
            help="Signs of a code that tell the appearances of a landmark apart, each with a "
            "prototype of its own: more precise, more bytes. 0 to 16, 0 for one prototype per "
            "landmark.",
        ),
    ] = 0,
    index: Annotated[
        bool,
        typer.Option(
            "--index",
            help="Learn inverted lists for approximate search in large maps: at most 4 more bytes "
            "per landmark.",
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
            help="Further metadata of the map; may be repeated. 'created' is now, or "
            "SOURCE_DATE_EPOCH if that is set.",
        ),
    ] = None,
    threads: Annotated[int, typer.Option(help="CPU threads.")] = 1,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the facts to this file.")
    ] = None,
) -> None:
    """Build a map from a tracks file.

    The map has the prototypes and the position of each landmark.
    Encoders for upright descriptors (freak-upright) take angles and sizes from the tracks.
    """
    from protomark import Encoder
    from protomark.cli.info import show
    from protomark.cli.terminal import check_outputs, write_json
    from protomark.maps.build import build_map
    from protomark.maps.info import describe
    from protomark.maps.metadata import command_metadata
    from protomark.tracks.file import Tracks

    check_outputs(output, json_file)
    for option, given in (
        ("--bytes", bytes_per_landmark is not None),
        ("--position-bits", position_bits != 32),
    ):
        if given and not sealed:
            raise ValueError(f"{option} is for sealed maps: add --sealed")
    texts = command_metadata(frame, metadata or [])
    observed = Tracks.load(tracks)
    scene = build_map(
        observed,
        Encoder.load(encoder or observed.descriptor),
        dim,
        min_observations=min_observations,
        appearance_bits=appearance_bits,
        threads=threads,
    )
    scene.metadata = texts
    if index:
        scene.build_index(threads=threads, in_place=True)  # nobody searches the map yet
    if sealed:
        scene.seal(output, bytes_per_landmark=bytes_per_landmark, position_bits=position_bits)
    else:
        scene.save(output)
    facts = describe(output)
    write_json(json_file, facts)
    show(facts)
