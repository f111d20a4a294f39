"""What several commands do with their options."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def numbers(option: str, text: str) -> tuple[int, ...]:
    """The numbers of a list such as 10000,1000000."""
    try:
        return tuple(int(number) for number in text.split(",") if number.strip())
    except ValueError:
        raise ValueError(f"{option} {text}: not numbers with commas between them") from None


def listed(text: str) -> tuple[str, ...]:
    """The names of a list such as toy,kitchen."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def write_json(path: Path | None, facts: dict[str, Any]) -> None:
    """Write the facts of a command to the file of `--json`, if one was named."""
    if path is not None:
        from protomark.files import write_text

        write_text(path, json.dumps(facts, indent=2) + "\n")
