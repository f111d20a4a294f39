"""The encoders that ship, each beside its card with data, licence and figures."""

from __future__ import annotations

import os
from pathlib import Path

SUFFIX = ".pme"
_FOLDER = Path(__file__).parent


def names() -> list[str]:
    """Names of the encoders that ship, such as "freak"."""
    return sorted(path.stem for path in _FOLDER.glob(f"*{SUFFIX}"))


def resolve(source: str | os.PathLike[str]) -> Path:
    """The model file of a bundled name or a path.

    Raises:
        FileNotFoundError: it is neither.
    """
    path = Path(source)
    if path.is_file():
        return path
    if str(source) in names():
        return _FOLDER / f"{source}{SUFFIX}"
    raise FileNotFoundError(
        f"{source}: neither a model file nor a bundled encoder ({', '.join(names()) or 'none'})"
    )
