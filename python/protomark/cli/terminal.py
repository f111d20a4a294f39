"""Terminal output, progress bars and result files, for all commands."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from protomark.files import write_text
from protomark.progress import Progress as Report

# Results go to stdout; progress and notes go to stderr, so that pipes contain results only.
console = Console()
error_console = Console(stderr=True)

# Seconds between lines of progress if stderr is no terminal.
_LINE_EVERY = 10.0


def printable(text: str) -> str:
    """The text with all characters escaped that are not printable."""
    return "".join(
        c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text
    )


def say(text: str) -> None:
    """Print one line with markup on stdout, without wrapping it."""
    console.print(text, highlight=False, soft_wrap=True)


def note(text: str) -> None:
    """Print one line as it is on stderr, without wrapping it."""
    error_console.print(printable(text), markup=False, highlight=False, soft_wrap=True)


def note_replaced(*paths: Path | None) -> None:
    """Say which of the files that -o names exist and will be replaced."""
    for path in paths:
        if path is not None and path.exists():
            note(f"{path} exists and will be replaced")


def note_outdated(path: Path) -> None:
    """Say that the sealed map beside a learning map was made of what that was before, if any."""
    from protomark.maps.seal import sealed_path

    if (sealed := sealed_path(path)).is_file():
        note(f"{sealed} was made of the map as it was before: remove it, or seal {path} again")


@contextmanager
def progress_bar(prefix: str = "") -> Iterator[Report]:
    """Yield a function that draws the progress of one stage after the other.

    A terminal shows a bar that disappears at the end, any other output a line every ten seconds.
    `prefix` comes before the name of each stage.
    """
    if not error_console.is_terminal:
        yield _plain_lines(prefix)
        return
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=error_console,
        transient=True,
        # Results that are printed meanwhile appear above the bar.
        redirect_stdout=console.is_terminal,
    ) as bar:
        task, current = bar.add_task(prefix, total=None), ""

        def report(stage: str, done: int, total: int) -> None:
            nonlocal current
            # A stage may append figures to its name after a comma, which do not restart the clock.
            name = stage.partition(",")[0]
            if name != current:
                bar.reset(task)
                current = name
            bar.update(task, description=prefix + stage, completed=done, total=total or None)

        yield report


def _plain_lines(prefix: str) -> Report:
    last = time.monotonic()

    def report(stage: str, done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= _LINE_EVERY:
            last = now
            note(f"{prefix}{stage}: {done} of {total}" if total else f"{prefix}{stage}: {done}")

    return report


def table_of(*columns: str, title: str = "", left: int = 1) -> Table:
    """A table with a rule under its head; columns after the first `left` align right."""
    from rich.box import SIMPLE_HEAD

    table = Table(
        title=title or None,
        title_justify="left",
        title_style="bold",
        header_style="",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
        show_edge=False,
    )
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i < left else "right", no_wrap=True)
    return table


def print_facts(rows: list[tuple[str, str]]) -> None:
    """Print names and values as a table without head or rules."""
    from rich.markup import escape

    table = Table.grid(padding=(0, 2))
    table.add_column()
    table.add_column(overflow="fold")
    for row in rows:
        table.add_row(*(escape(printable(cell)) for cell in row))
    console.print(table)


def readable_size(count: float) -> str:
    """A number of bytes in KB or MB (powers of ten)."""
    return f"{count / 1e6:.2f} MB" if count >= 1e6 else f"{count / 1e3:.0f} KB"


def write_json(path: Path | None, facts: Any) -> None:
    """Write the facts of a command to the file of `--json`, if there is one."""
    if path is not None:
        write_text(path, json.dumps(facts, indent=2) + "\n")


def comma_separated(text: str) -> tuple[str, ...]:
    """The names in a list such as toy,kitchen."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def comma_separated_numbers(option: str, text: str) -> tuple[int, ...]:
    """The numbers in a list such as 10000,1000000.

    Raises:
        ValueError: the text is not such a list; the error names the option.
    """
    try:
        return tuple(int(number) for number in comma_separated(text))
    except ValueError:
        raise ValueError(f"{option} {text!r} is not a list of numbers such as 8,16,32") from None


def decimal_numbers(option: str, text: str) -> tuple[float, ...] | None:
    """The numbers in a list such as 1.5,0,-2; None for an empty text.

    Raises:
        ValueError: the text is not such a list; the error names the option.
    """
    try:
        numbers = tuple(float(number) for number in comma_separated(text))
    except ValueError:
        numbers = (math.nan,)
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{option} {text!r} is not a list of numbers such as 1.5,0,-2")
    return numbers or None
