"""The `protomark` command."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    help="One small integer prototype per landmark instead of all its binary descriptors.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.command()
def train(
    tracks: Annotated[list[Path], typer.Argument(help="Tracks files to learn from.")],
    validation: Annotated[
        list[Path],
        typer.Option("--validation", help="Tracks file that picks the model; may be repeated."),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Model file to write (.pme).")],
    report: Annotated[
        list[Path] | None,
        typer.Option("--report", help="Tracks file to measure the result on; may be repeated."),
    ] = None,
    dims: Annotated[
        str, typer.Option(help="Code lengths that shall serve, ascending.")
    ] = "8,16,32",
    steps: Annotated[int, typer.Option(help="Batches in all.")] = 10_000,
    batch: Annotated[int, typer.Option(help="Landmarks in a batch.")] = 1000,
    seed: Annotated[int, typer.Option(help="Of weights and batches.")] = 0,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    threads: Annotated[
        int, typer.Option(help="CPU threads, 0 for one a core; take 1 on a busy machine.")
    ] = 0,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue from the checkpoint beside the output.")
    ] = False,
    name: Annotated[str, typer.Option(help="Name of the encoder; the output's if empty.")] = "",
    licence: Annotated[str, typer.Option(help="Licence of the weights, for the model file.")] = "",
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file.")
    ] = None,
) -> None:
    """Train an encoder on tracks, and write it with its card (needs PyTorch).

    Works for any binary descriptor of 64 to 1024 bits. Ctrl-C leaves a checkpoint beside the
    output, and the same command with --resume continues.
    """
    try:
        import torch  # noqa: F401
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "training needs PyTorch, which is not installed: pip install protomark[train]"
        ) from None
    from protomark.training.command import explain_interruption, print_summary, train_encoder
    from protomark.training.train import Interrupted, Options

    try:
        parsed = tuple(int(d) for d in dims.split(","))
    except ValueError:
        raise ValueError(f"--dims {dims!r} is not a list of numbers such as 8,16,32") from None
    options = Options(dims=parsed, steps=steps, landmarks=batch, seed=seed)
    try:
        card = train_encoder(
            tracks,
            validation,
            output,
            options,
            report=report or [],
            resume=resume,
            name=name,
            licence=licence,
            device=device,
            threads=threads,
            json_path=json_file,
        )
    except Interrupted as stop:
        explain_interruption(stop, output)
        raise typer.Exit(130) from None
    print_summary(card, output)


def main() -> None:
    """Run the command; an expected error becomes one sentence on stderr and exit code 1."""
    from rich.markup import escape

    from protomark.console import progress_console

    try:
        app()
    except (ValueError, OSError, KeyError, ModuleNotFoundError) as error:
        text = error.args[0] if isinstance(error, KeyError) and error.args else error
        message = f"[bold red]error:[/] {escape(str(text))}"
        progress_console.print(message, highlight=False, soft_wrap=True)
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
