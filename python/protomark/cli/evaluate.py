"""`protomark evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protomark.cli.options import listed


def evaluate(
    tracks: Annotated[
        list[Path], typer.Argument(help="Tracks files that `protomark tracks` wrote.")
    ],
    encoder: Annotated[
        list[str] | None,
        typer.Option(
            help="Name or file of an encoder; may be repeated. By default the descriptor's own."
        ),
    ] = None,
    upright: Annotated[
        bool,
        typer.Option(
            "--upright",
            help="Give Protomark the keypoints' angles and sizes, too (encoders such as "
            "freak-upright); all other methods get the plain descriptors.",
        ),
    ] = False,
    sized: Annotated[
        bool,
        typer.Option(
            "--sized",
            help="Give Protomark the keypoints' sizes, too (encoders such as freak-sized).",
        ),
    ] = False,
    methods: Annotated[
        str,
        typer.Option(
            help="Methods to compare, for example unaggregated,medoid,pca,protomark; "
            "by default all but the -float variants."
        ),
    ] = "",
    seeds: Annotated[int, typer.Option(min=1, help="Random splits, with seeds 0, 1, ...")] = 3,
    pose_frames: Annotated[
        int, typer.Option(min=0, help="Query keyframes to localize at each seed, at most.")
    ] = 20,
    discriminant_from: Annotated[
        list[Path] | None,
        typer.Option(
            help="Tracks file to learn the linear discriminants from; may be repeated. "
            "By default they are learned from the support."
        ),
    ] = None,
    threads: Annotated[
        int, typer.Option(min=0, help="CPU threads, 0 for all; search is timed on one.")
    ] = 0,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file.")
    ] = None,
    markdown_file: Annotated[
        Path | None, typer.Option("--markdown", help="Write the tables to this file.")
    ] = None,
    plot_file: Annotated[
        Path | None,
        typer.Option("--plot", help="Draw precision over bytes to this file (.png, .svg, .pdf)."),
    ] = None,
) -> None:
    """Compare precision, poses, bytes and search time of prototypes and of other methods.

    The protocol is the paper's: a random 90 % of the keyframes build the map, descriptors of the
    others ask it. docs/evaluation.md describes it, and every method.
    """
    from protomark.evaluation import command
    from protomark.evaluation.run import Options
    from protomark.evaluation.threads import available_threads
    from protomark.inputs import chosen

    command.check_plot(plot_file)
    command.check_outputs(json_file, markdown_file, plot_file)
    results = command.evaluate_files(
        tracks,
        Options(
            seeds=range(seeds), pose_frames=pose_frames, threads=threads or available_threads()
        ),
        encoders=encoder or [],
        methods=list(listed(methods)),
        discriminant_from=discriminant_from or [],
        inputs=chosen(upright, sized),
    )
    command.write(results, json_file, markdown_file, plot_file)
