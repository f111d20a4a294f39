"""Writes reports: Markdown pages with plots, JSON, and tables for the terminal."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from protomark.files import write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.table import Table


@dataclass(frozen=True)
class ReportTable:
    """A table of texts; rows with a bold first cell in Markdown stand out in the terminal.

    Attributes:
        heads: names of the columns.
        rows: cells as Markdown.
        words: number of leading columns with text; the others align right.
    """

    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    words: int = 1

    def markdown(self) -> str:
        """A GitHub table."""
        rule = ["---"] * self.words + ["---:"] * (len(self.heads) - self.words)
        lines = [self.heads, rule, *self.rows]
        return "\n".join("| " + " | ".join(line) + " |" for line in lines)

    def rich(self, title: str = "", columns: Sequence[int] | None = None) -> Table:
        """The table for a terminal, with the columns of these indices; None: all."""
        from rich.box import SIMPLE_HEAD
        from rich.table import Table

        chosen = range(len(self.heads)) if columns is None else columns
        table = Table(
            title=title,
            title_justify="left",
            box=SIMPLE_HEAD,
            padding=(0, 1, 0, 0),
            pad_edge=False,
            show_edge=False,
        )
        for i in chosen:
            justify: Any = "left" if i < self.words else "right"
            table.add_column(self.heads[i], justify=justify, overflow="fold")
        for row in self.rows:
            style = "bold green" if row[0].startswith("**") else ""
            table.add_row(*(row[i].replace("**", "") for i in chosen), style=style)
        return table


Part = str | ReportTable
_NUMBERS = re.compile(r"(?<=\[)\s+(?:[-+.\deE]+,\s+)*[-+.\deE]+\s+(?=\])")


@dataclass(frozen=True)
class Report:
    """The files that a command writes into its output folder.

    Attributes:
        name: stem of all files: `<name>.md`, `<name>.json` and `<name>-<plot>.svg`.
        command: the command, for the metadata of plots.
        results: JSON values.
        parts: paragraphs and tables of the page in order, without empty ones.
        plots: figures by name.
        summary: tables for the terminal.
        notes: sentences for the terminal, after the tables.
    """

    name: str
    command: str
    results: Mapping[str, Any]
    parts: Sequence[Part]
    plots: Mapping[str, Figure]
    summary: Sequence[Table] = ()
    notes: Sequence[str] = ()

    @property
    def markdown(self) -> str:
        """The page as Markdown."""
        texts = (part if isinstance(part, str) else part.markdown() for part in self.parts)
        return "\n\n".join(text for text in texts if text) + "\n"

    def publish(self, folder: Path) -> None:
        """Write all files into `folder`, each atomically, and print the summary."""
        from protomark.cli.terminal import console
        from protomark_bench.plot import save_svg

        folder.mkdir(parents=True, exist_ok=True)
        for plot, figure in self.plots.items():
            save_svg(figure, folder / f"{self.name}-{plot}.svg", self.command)
        save_json(folder / f"{self.name}.json", self.results)
        path = folder / f"{self.name}.md"
        write_text(path, self.markdown)
        for table in self.summary:
            console.print(table)
        for note in (*self.notes, f"report: {path}"):
            console.print(note, highlight=False, soft_wrap=True, markup=False)


def save_json(path: Path, results: Mapping[str, Any]) -> None:
    """Write results as JSON atomically, with lists of numbers on one line."""
    text = json.dumps(results, indent=1)
    text = _NUMBERS.sub(lambda match: re.sub(r"\s+", " ", match[0]), text)
    write_text(path, text + "\n")


def load_json(path: Path, format_name: str) -> dict[str, Any]:
    """Read results that `save_json` wrote, without format and version.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file holds no results of this format.
    """
    try:
        results = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        results = None
    if not isinstance(results, dict) or results.get("format") != format_name:
        raise ValueError(f"{path}: no results of the format {format_name}")
    del results["format"], results["version"]
    return results


def picture(report: str, plot: str, alt: str) -> str:
    """Markdown of a report's plot."""
    return f"![{alt}]({report}-{plot}.svg)"


def bullets(texts: Iterable[str]) -> str:
    """A Markdown list."""
    return "\n".join(f"- {text}" for text in texts)


def facts(values: Mapping[str, str]) -> str:
    """A Markdown list of names and values."""
    return bullets(f"{name}: {value}" for name, value in values.items())


def number(value: float | None, spec: str = ".3f") -> str:
    """A formatted number, or a dash for None."""
    return "–" if value is None else format(value, spec)


def duration(seconds: float) -> str:
    """Seconds in s, ms, µs or ns, with three digits."""
    scale, unit = next(
        (pair for pair in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")) if seconds >= pair[0]),
        (1e-9, "ns"),
    )
    return f"{seconds / scale:.3g} {unit}"
