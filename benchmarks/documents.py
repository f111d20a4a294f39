"""Tables that scripts write into documents, between marks."""

from __future__ import annotations

from pathlib import Path

from protomark.files import write_text

START, END = "<!-- tables: start -->", "<!-- tables: end -->"


def replace_tables(document: Path, tables: str) -> None:
    """Put the tables between the document's marks, or with marks at its end if it has none."""
    text = document.read_text(encoding="utf-8")
    if START not in text:
        text = f"{text.rstrip()}\n\n{START}\n{END}\n"
    before, rest = text.split(START)
    _, after = rest.split(END)
    write_text(document, f"{before}{START}\n\n{tables}\n{END}{after}")
