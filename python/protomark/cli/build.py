"""The command `protomark build`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protomark.cli.options import EncoderName, JsonFile, NoSeal, Threads


def build(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCE",
            help="Tracks of `protomark tracks`; a map of ORB-SLAM3 (.osa), ORB-SLAM2 (osmap), "
            "stella_vslam, RTAB-Map, OpenMVG, OpenSfM, kapture or Astrobee; images or a "
            "COLMAP database with SIFT or binary descriptors, followed by the folder of the COLMAP "
            "model. With --ray, also URLs of tracks files.",
        ),
    ],
    output: Annotated[
        str,
        typer.Option(
            "--output",
            "-o",
            metavar="PATH",
            help="Map file to write (.pmk); with --ray, a folder of shards, or its URL.",
        ),
    ],
    encoder: EncoderName = None,
    dim: Annotated[int | None, typer.Option(help="Numbers per prototype; by default 48.")] = None,
    min_observations: Annotated[
        int | None,
        typer.Option(
            help="Smallest number of observations of a landmark; by default 2, or 1 for sources "
            "that keep one descriptor per landmark."
        ),
    ] = None,
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
    no_seal: NoSeal = False,
    ray: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS|local",
            help="Build shards on a Ray cluster: HOST:PORT, auto for the one that runs on this "
            "machine, or local to start one.",
        ),
    ] = None,
    memory: Annotated[
        float | None,
        typer.Option(help="MB of memory of a worker of the cluster, by default 1000."),
    ] = None,
    cell_size: Annotated[
        float | None,
        typer.Option(
            help="Shards by space, cubes with edges of this length in the unit of the positions, "
            "instead of by id; only of one place."
        ),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Take over what the build had finished before it was cut."),
    ] = False,
    add: Annotated[
        bool,
        typer.Option("--add", help="Add the sources to the shards in the folder, which stay."),
    ] = False,
    threads: Threads = 1,
    json_file: JsonFile = None,
) -> None:
    """Build a map from tracks, or from a map of another program.

    Reads observations of landmarks and writes a learning map with the prototypes and the position
    of each landmark, and a sealed one beside it, scene.sealed.pmk: what ships, 33 bytes per
    landmark and its position (`protomark seal` makes other sizes). Several sources are several
    places, whose landmarks get ids apart, by the sources' names in order.

    protomark build kitchen.freak.safetensors -o kitchen.pmk

    protomark build atlas.osa -o scene.pmk

    protomark build database.db sparse/ -o scene.pmk

    protomark build session*.safetensors --ray local -o city/
    """
    from protomark import Encoder
    from protomark.cli.info import show
    from protomark.cli.terminal import note_replaced, progress_bar, write_json
    from protomark.distributed.build import MEMORY
    from protomark.distributed.build import build as build_shards
    from protomark.files import check_outputs
    from protomark.maps.build import build_map, tracks_for
    from protomark.maps.info import describe
    from protomark.maps.metadata import command_metadata
    from protomark.maps.origin import tracks_metadata
    from protomark.maps.seal import SealRequest, observed, seal_map, sealed_path
    from protomark.maps.selection import Views
    from protomark.maps.sources import read_places

    texts = command_metadata(frame, metadata or [])
    if ray is not None:
        check_outputs(json_file, inputs=[*sources, encoder])
        with progress_bar() as progress:
            facts = build_shards(
                sources,
                output,
                ray=ray,
                memory=memory or MEMORY,
                encoder=Encoder.load(encoder) if encoder else None,
                dim=dim,
                min_observations=min_observations,
                metadata=texts,
                seal=not no_seal,
                cell_size=cell_size,
                resume=resume,
                add=add,
                progress=progress,
            )
        write_json(json_file, facts)
        show(facts)
        return
    of_shards = {
        "--memory": memory is not None,
        "--cell-size": cell_size is not None,
        "--resume": resume,
        "--add": add,
    }
    for option in (option for option, given in of_shards.items() if given):
        raise ValueError(f"{option} is for shards: add --ray local")
    paths, target = [Path(source) for source in sources], Path(output)
    sealed = None if no_seal else sealed_path(target)
    check_outputs(json_file, inputs=[*paths, encoder], maps=[target, sealed])
    note_replaced(target, sealed)
    with progress_bar() as progress:
        progress("read sources", 0, 0)
        network = Encoder.load(encoder) if encoder else None
        descriptor = network.descriptor if network else None
        seen = read_places(paths, descriptor, min_observations, threads, progress)
        network = network or Encoder.load(seen.encoder_name)
        seen = tracks_for(network, seen)
        progress("build the map", 0, 0)
        scene = build_map(seen, network, dim, min_observations=1, threads=threads)
        scene.metadata = tracks_metadata(seen) | texts
        progress("write the map", 0, 0)
        scene.save(target)
        if sealed:
            sealed.unlink(missing_ok=True)  # it would not be of this map
            request = SealRequest(threads=threads)
            seal_map(
                scene, sealed, request, lambda: Views.of_tracks(seen), observed(seen), progress
            )
        facts = describe(target) | {"sources": seen.info["sources"]}
        if sealed:
            facts["sealed"] = {"file": str(sealed), "bytes": sealed.stat().st_size}
    write_json(json_file, facts)
    show(facts)
