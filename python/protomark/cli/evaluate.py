"""The command `protomark evaluate`."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from protomark.cli.options import JsonFile, Threads, TracksFiles

if TYPE_CHECKING:
    from rich.table import Table

    from protomark.evaluation.results import MethodSummary, SequenceResult


class SplitChoice(str, Enum):
    """Which keyframes query the map."""

    random = "random"
    later = "later"


def evaluate(
    tracks: TracksFiles,
    encoder: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME|FILE",
            help="Encoder that ships, or a model file (.pme); may be repeated. By default the one "
            "for the descriptor. An upright encoder gets the keypoints' angles and sizes, too.",
        ),
    ] = None,
    methods: Annotated[
        str,
        typer.Option(
            help="Methods to compare, for example unaggregated,medoid,pca,protomark. By default "
            "all but float, appearances and untuned ones, and pq, itq and lsh of 32 bytes only."
        ),
    ] = "",
    split: Annotated[
        SplitChoice,
        typer.Option(
            help="Queries: a random tenth of the keyframes, or revisits: the later keyframes in a "
            "map of the earlier ones."
        ),
    ] = SplitChoice.random,
    seeds: Annotated[int, typer.Option(min=1, help="Splits into map and queries.")] = 3,
    pose_frames: Annotated[int, typer.Option(min=0, help="Frames to localize per split.")] = 20,
    discriminant_from: Annotated[
        list[Path] | None,
        typer.Option(
            help="Tracks file to learn the linear discriminants from; may be repeated. "
            "By default they are learned from the map's own observations."
        ),
    ] = None,
    threads: Threads = 0,
    json_file: JsonFile = None,
    markdown_file: Annotated[
        Path | None, typer.Option("--markdown", help="Write the tables to this Markdown file, too.")
    ] = None,
    plot_file: Annotated[
        Path | None,
        typer.Option("--plot", help="Plot precision over bytes to this file (.png, .svg, .pdf)."),
    ] = None,
) -> None:
    """Compare Protomark with other ways to keep descriptors.

    Reads tracks and prints, for each method, the precision of search, the share of poses found,
    bytes per landmark and search time on one thread. The protocol is the paper's: a random 90 % of
    the keyframes build the map, and the descriptors of the others query it. `--split later` asks
    for revisits instead.

    protomark evaluate kitchen.freak.safetensors --plot precision.png
    """
    from protomark.cli.terminal import comma_separated, console, note, progress_bar
    from protomark.evaluation.results import (
        caption,
        evaluation_markdown,
        group_by_descriptor,
        mean_rows,
        save_json,
        save_precision_plot,
    )
    from protomark.evaluation.run import EvaluationOptions, evaluate_files
    from protomark.files import check_outputs, write_text
    from protomark.plot import check_suffix

    inputs = [*tracks, *(encoder or []), *(discriminant_from or [])]
    check_outputs(json_file, markdown_file, plot_file, inputs=inputs)
    if plot_file:
        check_suffix(plot_file)
    options = EvaluationOptions(
        split=split.value,
        seeds=range(seeds),
        pose_frames=pose_frames,
        threads=threads,
        encoders=encoder or [],
        methods=comma_separated(methods),
        discriminant_from=discriminant_from or [],
    )
    results: list[SequenceResult] = []
    with progress_bar() as progress:
        for result in evaluate_files(tracks, options, progress):
            results.append(result)
            console.print(results_table(caption(result), result.rows()))
            if not any(method.family.startswith("protomark") for method in result.methods):
                note(f"no encoder for {result.descriptor}: train one with `protomark train`")
    by_descriptor = group_by_descriptor(results)
    for descriptor, same in by_descriptor.items():
        if len(same) > 1:
            title = f"{descriptor.upper()}, {split.value} split: mean of {len(same)} sequences"
            console.print(results_table(title, mean_rows(same)))
    if json_file:
        save_json(results, json_file)
    if markdown_file:
        write_text(markdown_file, evaluation_markdown(results))
    if plot_file:
        for descriptor, same in by_descriptor.items():
            path = plot_file
            if len(by_descriptor) > 1:
                path = path.with_name(f"{path.stem}.{descriptor}{path.suffix}")
            rows = mean_rows(same) if len(same) > 1 else same[0].rows()
            names = ", ".join(result.sequence for result in same)
            save_precision_plot(rows, path, f"{descriptor.upper()}, {split.value} split: {names}")


def results_table(title: str, rows: Sequence[MethodSummary]) -> Table:
    """A table for a terminal of 80 columns, in which Protomark's rows stand out."""
    from protomark.cli.terminal import table_of
    from protomark.evaluation.results import table_row

    table = table_of(
        "method",
        "bytes per\nlandmark",
        "precision",
        "of un-\naggreg.",
        "poses\nfound",
        "right\nmatches",
        "ms per\n1,000",
        title=title,
    )
    for row in rows:
        ours = row.family.startswith("protomark")
        table.add_row(*table_row(row), style="bold green" if ours else "")
    return table
