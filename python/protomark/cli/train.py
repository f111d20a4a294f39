"""`protomark train`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def train(
    tracks: Annotated[
        list[Path], typer.Argument(help="Tracks files to learn from, one a sequence.")
    ],
    validation: Annotated[
        list[Path] | None,
        typer.Option(
            "--validation",
            help="Tracks file that picks the model; may be repeated. By default the last of TRACKS "
            "is not learned from but picks.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Model file to write; by default DESCRIPTOR.pme, if not there."
        ),
    ] = None,
    report: Annotated[
        list[Path] | None,
        typer.Option("--report", help="Tracks file to measure the result on; may be repeated."),
    ] = None,
    dims: Annotated[
        str, typer.Option(help="Code lengths that shall serve, ascending.")
    ] = "8,16,24,32,48,64",
    steps: Annotated[int, typer.Option(help="Batches in all.")] = 4000,
    batch: Annotated[int, typer.Option(help="Landmarks in a batch.")] = 1000,
    seed: Annotated[int, typer.Option(help="Of weights and batches.")] = 0,
    upright: Annotated[
        bool,
        typer.Option(
            "--upright", help="For cameras that do not roll: learn from angles and sizes, too."
        ),
    ] = False,
    sized: Annotated[
        bool,
        typer.Option(
            "--sized",
            help="For places seen from like distances again: learn from the keypoints' sizes, too.",
        ),
    ] = False,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    threads: Annotated[
        int, typer.Option(help="CPU threads, 0 for one a core; take 1 on a busy machine.")
    ] = 0,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue from the checkpoint beside the output.")
    ] = False,
    name: Annotated[str, typer.Option(help="Name of the encoder; the output's if empty.")] = "",
    licence: Annotated[str, typer.Option(help="Licence of the weights, for the model file.")] = "",
    data_licence: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=LICENCE", help="Licence of a sequence; may be repeated."),
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file.")
    ] = None,
) -> None:
    """Train an encoder on tracks, and write it with its card (needs PyTorch).

    Works for any binary descriptor of 64 to 1024 bits: `protomark train my-tracks/*`. Beside the
    model come its card (.md) and a picture of the training (.png) that is drawn anew at each
    validation. Ctrl-C leaves a checkpoint, and the same command with --resume continues.
    """
    try:
        import torch  # noqa: F401
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "training needs PyTorch, which is not installed: pip install protomark[train]"
        ) from None
    from protomark.inputs import chosen
    from protomark.training.command import (
        default_output,
        explain_interruption,
        print_summary,
        train_encoder,
    )
    from protomark.training.data import hold_out
    from protomark.training.train import Interrupted, Options

    try:
        parsed = tuple(int(d) for d in dims.split(","))
    except ValueError:
        raise ValueError(f"--dims {dims!r} is not a list of numbers such as 8,16,32") from None
    for entry in data_licence or []:
        if "=" not in entry:
            raise ValueError(f"--data-licence {entry!r} is not of the form NAME=LICENCE")
    data_licences = dict(entry.split("=", 1) for entry in data_licence or [])
    options = Options(dims=parsed, steps=steps, landmarks=batch, seed=seed)
    learned, picking = hold_out(tracks, validation or [])
    inputs = chosen(upright, sized)
    output = output or default_output(learned[0], resume, inputs)
    try:
        card = train_encoder(
            learned,
            picking,
            output,
            options,
            report=report or [],
            resume=resume,
            inputs=inputs,
            name=name,
            licence=licence,
            data_licences=data_licences,
            device=device,
            threads=threads,
            json_path=json_file,
        )
    except Interrupted as stop:
        explain_interruption(stop, output)
        raise typer.Exit(130) from None
    print_summary(card, output)
