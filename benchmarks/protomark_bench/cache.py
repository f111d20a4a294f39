"""A folder of finished measurements, so that a run that was interrupted can go on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.files import replacing, write_text

# To be raised when the same key would no longer give the same results.
_VERSION = 1


def key_of(**settings: Any) -> str:
    """A name for what these settings (JSON values) give, 20 hexadecimal digits."""
    text = json.dumps({"version": _VERSION, **settings}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


class ResultCache:
    """Results by key, each in a file that is written whole or not at all.

    A file that cannot be read counts as missing.

    Args:
        folder: created if it is missing.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def save(self, key: str, values: dict[str, Any]) -> None:
        """Stores JSON values."""
        write_text(self.folder / f"{key}.json", json.dumps(values) + "\n")

    def load(self, key: str) -> dict[str, Any] | None:
        """JSON values that were stored, None if there are none."""
        try:
            found = json.loads((self.folder / f"{key}.json").read_text())
        except (OSError, ValueError):
            return None
        return found if isinstance(found, dict) else None

    def get(self, key: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """JSON values that were stored, or those that `make` gives, which are stored then."""
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
        """What `save_arrays` stored, None if there is nothing."""
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(self.folder / f"{key}.safetensors", framework="numpy") as file:
                values = json.loads((file.metadata() or {})["values"])
                return values, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        except (SafetensorError, ValueError, KeyError, OSError):
            return None
