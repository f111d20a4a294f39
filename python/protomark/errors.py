"""The errors that are Protomark's own; wrong arguments raise ValueError, TypeError or KeyError."""

from __future__ import annotations

from protomark._core import FileError

__all__ = ["FileError"]
