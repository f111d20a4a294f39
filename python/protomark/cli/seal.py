"""The command `protomark seal`."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from protomark.cli.options import JsonFile, Threads


class IndexChoice(str, Enum):
    """Whether to build an index."""

    auto = "auto"
    yes = "yes"
    no = "no"


def seal(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SCENE",
            help="Folder of `protomark map`, a learning map (.pmk), or a tracks file.",
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Sealed map to write.")],
    bytes_per_landmark: Annotated[
        float,
        typer.Option(
            "--bytes",
            help="Bytes per landmark for prototypes, on average. 0: as many as it takes "
            "to answer exactly as the learning map.",
        ),
    ] = 33.0,
    megabytes: Annotated[
        float | None,
        typer.Option(help="Limit on the file, in MB (10^6 bytes), the encoder's 0.48 included."),
    ] = None,
    landmarks: Annotated[int | None, typer.Option(min=1, help="Limit on landmarks.")] = None,
    index: Annotated[
        IndexChoice,
        typer.Option(
            help="Index for approximate search, at most 4 bytes per prototype; auto: from 100,000 "
            "prototypes on."
        ),
    ] = IndexChoice.auto,
    position_bits: Annotated[
        int,
        typer.Option(
            help="Bits per coordinate: 16, exact to a 131,068th of the map's extent, or 32."
        ),
    ] = 16,
    no_positions: Annotated[
        bool, typer.Option("--no-positions", help="Leave positions out: a map for matching only.")
    ] = False,
    no_tune: Annotated[
        bool,
        typer.Option(
            "--no-tune",
            help="Keep plain means. By default prototypes are tuned, so that a landmark is less "
            "often mistaken for another; best where SCENE is tracks, which have all observations.",
        ),
    ] = False,
    threads: Threads = 0,
    json_file: JsonFile = None,
) -> None:
    """Seal a map: small, mapped from disk, read-only; what ships.

    Where not all landmarks may stay, those stay that cover the images, or the space, best. Cameras
    and metadata go along. Seal again, to other sizes, whenever the learning map has learned.

    protomark seal kitchen -o kitchen.sealed.pmk --megabytes 1
    """
    from protomark.cli.info import show
    from protomark.cli.terminal import note, note_replaced, progress_bar, write_json
    from protomark.files import SCENE_MAP, check_outputs
    from protomark.maps.info import describe
    from protomark.maps.seal import SealRequest, check_replaceable
    from protomark.maps.seal import seal as seal_source

    check_outputs(json_file, inputs=[source, source / SCENE_MAP], maps=[output])
    check_replaceable(output)
    note_replaced(output)
    request = SealRequest(
        bytes_per_landmark=bytes_per_landmark or None,
        megabytes=megabytes,
        landmarks=landmarks,
        index=index.value,
        position_bits=0 if no_positions else position_bits,
        tune=not no_tune,
        threads=threads,
    )
    with progress_bar() as progress:
        made = seal_source(source, output, request, progress)
    if made["chosen_by"]:
        note(
            f"{made['landmarks']:,} of {made['landmarks_of_the_source']:,} landmarks were kept, "
            f"those that cover the {made['chosen_by']} best"
        )
    facts = describe(output)
    write_json(json_file, {**facts, **made})
    show(facts)
