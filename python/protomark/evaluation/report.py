"""Tables of an evaluation, for the terminal and for Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from protomark.evaluation.results import SequenceResult, Summary, mean_rows

if TYPE_CHECKING:
    from rich.table import Table

_HEADS = (
    "method",
    "bytes per landmark",
    "precision",
    "of unaggregated",
    "poses found",
    "right matches",
    "ms per 1,000 queries",
)


def caption(result: SequenceResult) -> str:
    """What was evaluated, in one line."""
    return (
        f"{result.sequence}, {result.descriptor.upper()}: {result.keyframes} keyframes, "
        f"{result.map_landmarks:,.0f} landmarks in the map from "
        f"{result.support_observations:,.0f} observations, {result.queries:,.0f} queries, "
        f"{len(result.seeds)} seed{'s' if len(result.seeds) != 1 else ''}"
    )


def cells(row: Summary) -> list[str]:
    """One row as text."""
    spread = f" ±{row.spread:.3f}" if row.spread is not None else ""
    return [
        row.label,
        f"{row.bytes_per_landmark:,.0f}",
        f"{row.precision:.3f}{spread}",
        percent(row.ratio),
        percent(row.pose_recall),
        percent(row.right_share),
        f"{row.search_ms:,.0f}" if row.search_ms >= 10 else f"{row.search_ms:.1f}",
    ]


def percent(share: float | None) -> str:
    """A share in percent, or a dash."""
    return "–" if share is None else f"{100 * share:.1f}%"


def rich_table(title: str, rows: Sequence[Summary]) -> Table:
    """A table for a terminal of 80 columns; Protomark's own rows stand out."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(
        title=title,
        title_justify="left",
        title_style="bold",
        header_style="",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
        show_edge=False,
    )
    narrow = (
        "method",
        "bytes per\nlandmark",
        "precision",
        "of un-\naggreg.",
        "poses\nfound",
        "right\nmatches",
        "ms per\n1,000",
    )
    for head in narrow:
        table.add_column(head, justify="left" if head == "method" else "right", no_wrap=True)
    for row in rows:
        table.add_row(*cells(row), style="bold green" if is_ours(row) else "")
    return table


def markdown_table(rows: Sequence[Summary]) -> str:
    """A GitHub table; Protomark's own rows are bold."""
    lines = [
        "| " + " | ".join(_HEADS) + " |",
        "|---|" + "---:|" * (len(_HEADS) - 1),
    ]
    for row in rows:
        texts = cells(row)
        if is_ours(row):
            texts = [f"**{text}**" for text in texts]
        lines.append("| " + " | ".join(texts) + " |")
    return "\n".join(lines) + "\n"


def markdown(results: Sequence[SequenceResult]) -> str:
    """All tables, and their mean where there are several, one descriptor after the other."""
    parts = []
    for descriptor in dict.fromkeys(result.descriptor for result in results):
        same = [result for result in results if result.descriptor == descriptor]
        if len(same) > 1:
            names = ", ".join(result.sequence for result in same)
            parts.append(f"#### {descriptor.upper()}: mean of {names}\n")
            parts.append(markdown_table(mean_rows(same)))
        for result in same:
            parts.append(f"#### {caption(result)}\n")
            parts.append(markdown_table(result.rows()))
    return "\n".join(parts)


def is_ours(row: Summary) -> bool:
    """Whether a row is Protomark's."""
    return row.family.startswith("protomark")
