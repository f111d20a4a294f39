"""Command lines of reports, and resumable commands."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import typer


def command_line(command: str, paths: Sequence[Path] | None, **options: object) -> str:
    """The command line that repeats a run, for its report: files have no folders.

    Args:
        command: name of the command.
        paths: arguments.
        options: values, or pairs of a value and its default; empty and default ones are left out.
    """
    words = ["protomark", command, *(path.resolve().name for path in paths or ())]
    for name, given in options.items():
        value, default = given if isinstance(given, tuple) else (given, "")
        if value is None or value == default:
            continue
        text = value.name if isinstance(value, Path) else str(value)
        option = name.replace("_", "-")
        words.append(f"--no-{option}" if value is False else f"--{option} {text}")
    return " ".join(words)


@contextmanager
def resumable(output: Path) -> Iterator[None]:
    """On Ctrl-C end the command with exit code 130, and tell how to continue."""
    try:
        yield
    except KeyboardInterrupt:
        from protomark.cli.terminal import note

        note(f"stopped: results so far are cached in {output}, and the same command continues")
        raise typer.Exit(130) from None
