"""Caches finished measurements in a folder, so that an interrupted run can continue."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.files import replacing, write_text

# Increased whenever the same key would yield other results.
_VERSION = 1


def key_of(**settings: Any) -> str:
    """A key for the result of these settings (JSON values), 20 hexadecimal digits."""
    text = json.dumps({"version": _VERSION, **settings}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


class ResultCache:
    """Results by key, each in a file of its own; an unreadable file counts as missing.

    Args:
        folder: folder of the files, created if it does not exist.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def save(self, key: str, values: dict[str, Any]) -> None:
        """Stores JSON values."""
        write_text(self.folder / f"{key}.json", json.dumps(values) + "\n")

    def load(self, key: str) -> dict[str, Any] | None:
        """The stored JSON values, None if there are none."""
        try:
            found = json.loads((self.folder / f"{key}.json").read_text())
        except (OSError, ValueError):
            return None
        return found if isinstance(found, dict) else None

    def get(self, key: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """The stored JSON values, or new ones that `make` returns, which are then stored."""
        found = self.load(key)
        if found is None:
            found = make()
            self.save(key, found)
        return found

    def save_arrays(
        self, key: str, values: dict[str, Any], arrays: dict[str, NDArray[np.float32]]
    ) -> None:
        """Stores JSON values and arrays in one file."""
        from safetensors.numpy import save

        with replacing(self.folder / f"{key}.safetensors") as file:
            file.write(save(arrays, metadata={"values": json.dumps(values)}))

    def load_arrays(self, key: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]] | None:
        """The values and arrays that `save_arrays` stored, None if there are none."""
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(self.folder / f"{key}.safetensors", framework="numpy") as file:
                values = json.loads((file.metadata() or {})["values"])
                return values, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        except (SafetensorError, ValueError, KeyError, OSError):
            return None
