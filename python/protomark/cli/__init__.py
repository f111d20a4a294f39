"""The `protomark` command: one file a command, in the order in which `--help` lists them here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import typer

from protomark.cli.build import build
from protomark.cli.calibrate import calibrate
from protomark.cli.demo import demo
from protomark.cli.evaluate import evaluate
from protomark.cli.info import info
from protomark.cli.join import join
from protomark.cli.localize import localize
from protomark.cli.map import map_
from protomark.cli.plugins import CommandGroup
from protomark.cli.split import split
from protomark.cli.tracks import tracks
from protomark.cli.train import train

app = typer.Typer(
    cls=CommandGroup,
    help="One small integer prototype per landmark instead of all its binary descriptors.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_COMMANDS: dict[str, Callable[..., Any]] = {
    "tracks": tracks,
    "train": train,
    "build": build,
    "map": map_,
    "localize": localize,
    "calibrate": calibrate,
    "join": join,
    "split": split,
    "info": info,
    "demo": demo,
    "evaluate": evaluate,
}
for name, command in _COMMANDS.items():
    app.command(name)(command)


def _print_version(wanted: bool) -> None:
    if wanted:
        from protomark import __version__

        typer.echo(f"protomark {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """One small integer prototype per landmark instead of all its binary descriptors."""


def main() -> None:
    """Run the command; an expected error becomes one sentence on stderr and exit code 1."""
    from rich.markup import escape

    from protomark.console import printable, progress_console

    try:
        app()
    except (ValueError, OSError, KeyError, ModuleNotFoundError) as error:
        text = error.args[0] if isinstance(error, KeyError) and error.args else error
        message = f"[bold red]error:[/] {escape(printable(str(text)))}"
        progress_console.print(message, highlight=False, soft_wrap=True)
        raise SystemExit(1) from None
