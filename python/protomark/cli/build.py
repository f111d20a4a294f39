"""The command `protomark build`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protomark.cli.options import EncoderName, JsonFile, Threads


def build(
    tracks: Annotated[
        Path, typer.Argument(metavar="TRACKS", help="Tracks file that `protomark tracks` wrote.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Map file to write (.pmk).")],
    encoder: EncoderName = None,
    dim: Annotated[
        int | None,
        typer.Option(help="Numbers per prototype; by default as many as the encoder has."),
    ] = None,
    min_observations: Annotated[
        int, typer.Option(help="Leave out landmarks with fewer observations.")
    ] = 2,
    sealed: Annotated[
        bool,
        typer.Option("--sealed", help="Write a sealed map: small, mapped from disk, read-only."),
    ] = False,
    bytes_per_landmark: Annotated[
        float | None,
        typer.Option(
            help="Limit on a sealed map's bytes per landmark for prototypes and count, on average, "
            "for example 33. Without it the sealed map answers exactly as the learning map.",
        ),
    ] = None,
    appearance_bits: Annotated[
        int,
        typer.Option(
            min=0,
            help="Keep up to 2^N appearances per landmark (from several sides, in other light), "
            "each as a prototype of its own: more precise, more bytes. 10 suits most maps, 0 keeps "
            "one prototype per landmark.",
        ),
    ] = 0,
    index: Annotated[
        bool,
        typer.Option(
            "--index",
            help="Add an index for fast approximate search in large maps, for at most 4 more bytes "
            "per landmark.",
        ),
    ] = False,
    position_bits: Annotated[
        int,
        typer.Option(
            help="Bits per coordinate of a sealed map's positions: 32, or 16, which halves their "
            "bytes and moves them by at most a 131,068th of the map's extent."
        ),
    ] = 32,
    frame: Annotated[
        str | None,
        typer.Option(
            help="Coordinate frame and unit of the positions, for the map's metadata: 'ENU, "
            "metres', 'COLMAP, no scale', 'map (REP 105), metres'."
        ),
    ] = None,
    metadata: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=TEXT",
            help="Further metadata of the map; may be repeated. 'created' is the current time, or "
            "that of SOURCE_DATE_EPOCH.",
        ),
    ] = None,
    threads: Threads = 1,
    json_file: JsonFile = None,
) -> None:
    """Build a map from tracks.

    Reads one tracks file and writes one map file with the prototypes and the position of each
    landmark: a learning map, or with --sealed a sealed one.

    protomark build kitchen.freak.safetensors -o kitchen.pmk

    protomark build kitchen.freak.safetensors -o kitchen.sealed.pmk --sealed --appearance-bits 10
    --bytes-per-landmark 33
    """
    from protomark import Encoder
    from protomark.cli.info import show
    from protomark.cli.terminal import check_outputs, progress_bar, write_json
    from protomark.maps.build import build_map
    from protomark.maps.info import describe
    from protomark.maps.metadata import command_metadata
    from protomark.threads import available_threads
    from protomark.tracks.file import Tracks

    check_outputs(output, json_file)
    for option, given in (
        ("--bytes-per-landmark", bytes_per_landmark is not None),
        ("--position-bits", position_bits != 32),
    ):
        if given and not sealed:
            raise ValueError(f"{option} is for sealed maps: add --sealed")
    texts = command_metadata(frame, metadata or [])
    threads = threads or available_threads()
    with progress_bar() as progress:
        progress("read tracks", 0, 0)
        observed = Tracks.load(tracks)
        progress("build the map", 0, 0)
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
            progress("build the index", 0, 0)
            scene.build_index(threads=threads, in_place=True)  # nobody searches the map yet
        progress("write the map", 0, 0)
        if sealed:
            scene.seal(output, bytes_per_landmark=bytes_per_landmark, position_bits=position_bits)
        else:
            scene.save(output)
        facts = describe(output)
    write_json(json_file, facts)
    show(facts)
