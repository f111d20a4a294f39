"""`protomark reproduce`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def reproduce(
    data: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="DATA",
            help="Tracks files, folders of them, or folders of sequences with images/ and "
            "sparse/, whose tracks are made first. By default the sequences in data, ../data or "
            "../shared/data.",
        ),
    ] = None,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder for the report and all that is kept."),
    ] = Path("reproduction"),
    scale: Annotated[
        str,
        typer.Option(
            help="small: minutes, on the sequences whose tracks are quickly made; medium: all "
            "sequences, short trainings; full: trained until the validation loss stagnates, hours."
        ),
    ] = "small",
    descriptor: Annotated[
        str, typer.Option("--descriptor", "-d", help="Descriptor; the paper's is freak.")
    ] = "freak",
    train: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Sequence to train on; may be repeated."),
    ] = None,
    validation: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Sequence to pick networks on; may be repeated."),
    ] = None,
    test: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Sequence to measure on; may be repeated."),
    ] = None,
    jobs: Annotated[
        int, typer.Option(min=0, help="Trainings at a time, 0 for as many as cores allow.")
    ] = 0,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads of one training.")] = 1,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file too.")
    ] = None,
) -> None:
    """Run the paper's whole evaluation again and report it beside the paper's numbers.

    Trains 'fat' and 'funnel' networks of 2 to 5 layers as triplet and as prototypical networks,
    compares prototypes of 8 to 64 dimensions and the other methods of the paper's table, and
    writes report.md with its figures (needs PyTorch). Finished trainings are kept: after Ctrl-C
    the same command goes on. Sequences of other names than the project's own need --train,
    --validation and --test. docs/reproduction.md says more.
    """
    try:
        import torch  # noqa: F401
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "reproduce trains networks with PyTorch, which is not installed: "
            "pip install protomark[train]"
        ) from None
    from protomark.evaluation.threads import available_threads
    from protomark.reproduce import command
    from protomark.reproduce.scale import find_scale

    settings = command.Settings(
        scale=find_scale(scale),
        descriptor=descriptor,
        jobs=jobs or max(available_threads() // threads, 1),
        threads=threads,
        given={"training": train or [], "validation": validation or [], "test": test or []},
    )
    try:
        results = command.reproduce(data or [], output, settings, json_file)
    except KeyboardInterrupt:
        command.explain_interruption(output)
        raise typer.Exit(130) from None
    command.print_summary(results, output)
