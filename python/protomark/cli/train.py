"""The command `protomark train`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from protomark.training.card import EncoderCard
    from protomark.training.encoder import TrainingRequest


def train(
    tracks: Annotated[
        list[Path], typer.Argument(help="Tracks files to train on, one per sequence.")
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
            "--upright",
            help="For cameras that do not roll: train on angles and sizes of keypoints, too.",
        ),
    ] = False,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    threads: Annotated[
        int, typer.Option(help="CPU threads, 0 for one per core; take 1 on a busy machine.")
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
    """Train an encoder on tracks (needs PyTorch).

    Works for any binary descriptor of 64 to 1024 bits: `protomark train my-tracks/*`. Beside the
    model come its card (.md) and a picture of the training (.png) that is drawn anew at each
    validation. Ctrl-C leaves a checkpoint, and the same command with --resume continues.
    """
    from protomark.cli.terminal import check_outputs, note, progress_bar, write_json
    from protomark.extras import optional

    check_outputs(json_file)
    optional("torch")
    from protomark.training.data import hold_out
    from protomark.training.encoder import TrainingRequest, default_output, train_encoder
    from protomark.training.train import TrainingInterrupted, TrainingOptions

    try:
        parsed = tuple(int(d) for d in dims.split(","))
    except ValueError:
        raise ValueError(f"--dims {dims!r} is not a list of numbers such as 8,16,32") from None
    for entry in data_licence or []:
        if "=" not in entry:
            raise ValueError(f"--data-licence {entry!r} is not of the form NAME=LICENCE")
    training, selecting = hold_out(tracks, validation or [])
    request = TrainingRequest(
        training,
        selecting,
        output or default_output(training[0], resume, upright),
        TrainingOptions(dims=parsed, steps=steps, landmarks=batch, seed=seed),
        report=report or [],
        resume=resume,
        upright=upright,
        name=name,
        licence=licence,
        data_licences=dict(entry.split("=", 1) for entry in data_licence or []),
        device=device,
        threads=threads,
    )
    try:
        with progress_bar() as progress:
            card = train_encoder(request, progress, note)
    except TrainingInterrupted as stop:
        note(f"{stop}; the same command with --resume continues ({request.output}.checkpoint)")
        raise typer.Exit(130) from None
    write_json(json_file, asdict(card))
    _show(card, request)


def _show(card: EncoderCard, request: TrainingRequest) -> None:
    from protomark.cli.terminal import console, say, table_of

    table = table_of("sequence", "unaggregated", "dim", "bytes", "float", "integer", "ratio")
    for f in card.figures:
        for d in card.dims:
            table.add_row(
                f"{f.sequence} ({f.role})",
                f"{f.unaggregated:.4f}",
                str(d),
                str(d + 1),
                f"{f.float_precision[d]:.4f}",
                f"{f.integer_precision[d]:.4f}",
                f"{f.integer_precision[d] / max(f.unaggregated, 1e-9):.3f}",
            )
    console.print(table)
    say(f"{request.output} ({card.bytes:,} bytes), {request.card_path} and {request.plot_path}")
