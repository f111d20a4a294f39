"""The command `protomark train`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from protomark.cli.options import JsonFile, Threads, TracksFiles

if TYPE_CHECKING:
    from protomark.training.card import EncoderCard
    from protomark.training.encoder import TrainingRequest


def train(
    tracks: TracksFiles,
    validation: Annotated[
        list[Path] | None,
        typer.Option(
            "--validation",
            help="Tracks file that selects the best model; may be repeated. By default the last of "
            "TRACKS, which is then not trained on.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Model file to write; by default DESCRIPTOR.pme, if it is new."
        ),
    ] = None,
    report: Annotated[
        list[Path] | None,
        typer.Option("--report", help="Tracks file to measure the result on; may be repeated."),
    ] = None,
    dims: Annotated[str, typer.Option(help="Code lengths, ascending.")] = "8,16,24,32,48,64",
    steps: Annotated[int, typer.Option(help="Number of batches.")] = 4000,
    batch: Annotated[int, typer.Option(help="Landmarks per batch.")] = 1000,
    seed: Annotated[int, typer.Option(help="Seed of weights and batches.")] = 0,
    upright: Annotated[
        bool,
        typer.Option(
            "--upright",
            help="For cameras that do not roll: train on angles and sizes of keypoints, too.",
        ),
    ] = False,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    threads: Threads = 0,
    resume: Annotated[bool, typer.Option("--resume", help="Continue from the checkpoint.")] = False,
    name: Annotated[str, typer.Option(help="Name of the encoder; by default the output's.")] = "",
    licence: Annotated[str, typer.Option(help="Licence of the weights, for the model file.")] = "",
    data_licence: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=LICENCE", help="Licence of a sequence; may be repeated."),
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Train an encoder on tracks (needs PyTorch).

    Reads tracks of any binary descriptor of 64 to 1024 bits, or vector of 16 to 1024 numbers.
    Writes the model (.pme), its card (.md) and a picture of the training (.png) that is redrawn at
    each validation.

    protomark train tracks/*.freak.safetensors -o my-freak.pme

    Ctrl-C leaves a checkpoint, and the same command with --resume continues.
    """
    from protomark.cli.terminal import comma_separated_numbers, note, progress_bar, write_json
    from protomark.extras import optional
    from protomark.files import check_outputs

    inputs = [*tracks, *(validation or []), *(report or [])]
    check_outputs(output, json_file, inputs=inputs)
    optional("torch")
    from protomark.training.data import hold_out
    from protomark.training.encoder import TrainingRequest, default_output, train_encoder
    from protomark.training.train import TrainingOptions

    numbers = comma_separated_numbers("--dims", dims)
    for entry in data_licence or []:
        if "=" not in entry:
            raise ValueError(f"--data-licence {entry!r} is not of the form NAME=LICENCE")
    training, selecting = hold_out(tracks, validation or [])
    request = TrainingRequest(
        training,
        selecting,
        output or default_output(training[0], resume, upright),
        TrainingOptions(dims=numbers, steps=steps, landmarks=batch, seed=seed),
        report=report or [],
        resume=resume,
        upright=upright,
        name=name,
        licence=licence,
        data_licences=dict(entry.split("=", 1) for entry in data_licence or []),
        device=device,
        threads=threads,
    )
    with progress_bar() as progress:
        card = train_encoder(request, progress, note)
    write_json(json_file, asdict(card))
    _show(card, request)


def _show(card: EncoderCard, request: TrainingRequest) -> None:
    from protomark.cli.terminal import console, say, table_of

    table = table_of("sequence", "unaggregated", "dim", "bytes", "float", "integer", "ratio")
    for sequence, _, unaggregated, _, _, *rest in card.figure_rows():
        table.add_row(sequence, unaggregated, *rest)
    console.print(table)
    say(f"{request.output} ({card.bytes:,} bytes), {request.card_path} and {request.plot_path}")
