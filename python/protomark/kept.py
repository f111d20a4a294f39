"""Finished measurements, kept in files so that a run that was cut goes on."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from protomark.files import write_text

# To be raised when the same key would no longer give the same figures.
_VERSION = 1


def key_of(**settings: Any) -> str:
    """A name for what these settings (JSON values) give, 20 hexadecimal digits."""
    text = json.dumps({"version": _VERSION, **settings}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


class Kept:
    """A folder of measurements, each in a file of its key; files are written whole or not at all.

    A file that cannot be read counts as missing: its result is made anew.

    Args:
        folder: made if it is missing.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def save_figures(self, key: str, figures: dict[str, Any]) -> None:
        """Keep a measurement (JSON values)."""
        write_text(self._figures(key), json.dumps(figures) + "\n")

    def load_figures(self, key: str) -> dict[str, Any] | None:
        """A kept measurement, None if it is not there."""
        try:
            found = json.loads(self._figures(key).read_text())
        except (OSError, ValueError):
            return None
        return found if isinstance(found, dict) else None

    def _figures(self, key: str) -> Path:
        return self.folder / f"figures.{key}.json"
