"""The command `protomark info`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from protomark.cli.options import JsonFile

_BARS = "▁▂▃▄▅▆▇█"


def info(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="A map or its folder, an encoder or tracks.")
    ],
    verify: Annotated[
        bool,
        typer.Option(
            "--verify", help="Check every checksum of a map or an encoder; tracks have none."
        ),
    ] = False,
    json_file: JsonFile = None,
) -> None:
    """Describe what a file holds, and what its bytes are spent on.

    protomark info kitchen/scene.pmk --verify
    """
    from protomark import verify_file
    from protomark.cli.terminal import error_console, write_json
    from protomark.files import check_outputs
    from protomark.maps.info import describe, is_tracks
    from protomark.maps.open import map_path

    check_outputs(json_file, inputs=[file])
    with error_console.status(f"Reading {file.name}"):
        facts = describe(file)
        if verify and is_tracks(file):
            facts["checksums"] = "none in a tracks file, which is checked whole whenever it is read"
        elif verify:
            verify_file(map_path(file))
            facts["checksums"] = "all right"
    write_json(json_file, facts)
    show(facts)


def show(facts: dict[str, Any]) -> None:
    """Print what `protomark.maps.info.describe` returned."""
    from protomark.cli.terminal import print_facts

    print_facts(list(_rows(facts)))


def _rows(facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for key, value in facts.items():
        name = key.replace("_", " ")
        if value is None or key == "bytes_per_landmark_by_section":
            continue
        if key == "count_histogram":
            yield "observations per landmark", f"1 {_bars(value)} 16 and more"
        elif key == "extent":
            yield name, " to ".join(_vector(corner) for corner in value)
        elif key == "position_error":
            yield name, _vector(value)
        elif key == "bytes_by_section":
            for section, size in value.items():
                each = facts["bytes_per_landmark_by_section"][section]
                yield _text(f"bytes: {section}"), f"{size:,}  {each:,.2f} per landmark"
        elif isinstance(value, dict):
            yield from _nested_rows(name, value)
        else:
            yield name, _text(value)


def _nested_rows(name: str, values: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for key, value in values.items():
        label = f"{name}: {key.replace('_', ' ')}"
        if key == "notes" and isinstance(value, dict):
            for note, text in value.items():
                yield _text(f"{label}: {note.replace('_', ' ')}"), _text(text)
        else:
            yield _text(label), _text(value)


def _bars(histogram: list[int]) -> str:
    """Numbers of landmarks with 1, 2, ..., 16 and more observations, as one line of bars."""
    bins = [*histogram[1:16], sum(histogram[16:])]
    top = max(max(bins), 1)
    return "".join(_BARS[int(v / top * (len(_BARS) - 1))] if v else " " for v in bins)


def _vector(values: list[float]) -> str:
    return f"({', '.join(f'{v:,.6g}' for v in values)})"


def _text(value: Any) -> str:
    if isinstance(value, str) and not value.isprintable():
        # A stranger's file must not control the terminal.
        return "".join(c if c.isprintable() else repr(c)[1:-1] for c in value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return str(value)
    return f"{value:,}" if isinstance(value, int) else f"{value:,.2f}"
