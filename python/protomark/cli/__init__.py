"""The `protomark` command: one file per command, listed by `--help` in the order given here."""

from __future__ import annotations

import io
import os
import signal
import sys
import warnings
from collections.abc import Callable
from typing import Annotated, Any

import typer

from protomark.cli.align import align
from protomark.cli.build import build
from protomark.cli.calibrate import calibrate
from protomark.cli.crop import crop
from protomark.cli.demo import demo
from protomark.cli.evaluate import evaluate
from protomark.cli.export import export
from protomark.cli.info import info
from protomark.cli.localize import localize
from protomark.cli.map import map_
from protomark.cli.merge import merge
from protomark.cli.plugins import CommandGroup
from protomark.cli.seal import seal
from protomark.cli.serve import serve
from protomark.cli.split import split
from protomark.cli.tracks import tracks
from protomark.cli.train import train

_SUMMARY = "Visual maps that keep a few small integer prototypes per landmark."

app = typer.Typer(
    cls=CommandGroup,
    rich_markup_mode=None,  # Rich would double the time of --help
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_COMMANDS: dict[str, Callable[..., Any]] = {
    "map": map_,
    "localize": localize,
    "serve": serve,
    "tracks": tracks,
    "build": build,
    "seal": seal,
    "merge": merge,
    "split": split,
    "crop": crop,
    "align": align,
    "export": export,
    "info": info,
    "demo": demo,
    "evaluate": evaluate,
    "train": train,
    "calibrate": calibrate,
}
for name, command in _COMMANDS.items():
    app.command(name)(command)


def _print_version(wanted: bool) -> None:
    if wanted:
        from protomark import __version__

        typer.echo(f"protomark {__version__}")
        raise typer.Exit


@app.callback(help=_SUMMARY)
def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Handle the options before a command."""


def main() -> None:
    """Run the command.

    An expected error prints one sentence to stderr and exits with 1; Ctrl-C and SIGTERM exit with
    130.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    warnings.showwarning = _warn
    # A sentence of ours names each image that cannot be read.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")
    from protomark.interrupt import Interrupted

    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal may know ASCII only
    try:
        if "" in sys.argv[1:]:
            raise ValueError("an argument is empty: is a variable of the shell not set?")
        app(prog_name="protomark")
    except Interrupted as stop:
        from protomark.cli.terminal import note

        note(str(stop))
        raise SystemExit(130) from None
    except (KeyboardInterrupt, SystemExit) as end:
        if isinstance(end, SystemExit) and end.code != 130:
            raise
        _fail("stopped", 130)
    except (ValueError, OSError, KeyError, ModuleNotFoundError) as error:
        text = error.args[0] if isinstance(error, KeyError) and error.args else error
        _fail(str(text), 1)


def _warn(message: Warning | str, *_: Any, **__: Any) -> None:
    from protomark.cli.terminal import note

    note(f"warning: {message}")


def _fail(text: str, code: int) -> None:
    from rich.markup import escape

    from protomark.cli.terminal import error_console, printable

    message = f"[bold red]error:[/] {escape(printable(text))}"
    error_console.print(message, highlight=False, soft_wrap=True)
    raise SystemExit(code) from None
