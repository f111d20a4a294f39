"""What the commands do with their options."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import typer


def command_line(command: str, paths: Sequence[Path] | None, **options: object) -> str:
    """The command that does the same again, as a report tells it: files by name alone.

    Args:
        command: its name.
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
    """Ctrl-C inside ends the command with exit code 130 and says how to go on."""
    try:
        yield
    except KeyboardInterrupt:
        from protomark.cli.terminal import note

        note(f"stopped; what is finished is cached in {output}, and the same command goes on")
        raise typer.Exit(130) from None
