"""Tables that scripts write into documents, between marks."""

from __future__ import annotations

from pathlib import Path

from protomark.files import write_text


def replace_tables(document: Path, tables: str, name: str = "tables") -> None:
    """Put the tables between the document's marks, or with marks at its end if it has none.

    Args:
        document: Markdown with the marks `<!-- name: start -->` and `<!-- name: end -->`.
        tables: what comes between them.
        name: of the marks.
    """
    start, end = f"<!-- {name}: start -->", f"<!-- {name}: end -->"
    text = document.read_text(encoding="utf-8")
    if start not in text:
        text = f"{text.rstrip()}\n\n{start}\n{end}\n"
    before, rest = text.split(start)
    _, after = rest.split(end)
    write_text(document, f"{before}{start}\n\n{tables}\n{end}{after}")
