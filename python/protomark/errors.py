"""The errors that are Protomark's own; wrong arguments raise ValueError, TypeError or KeyError."""

from __future__ import annotations


class FileError(OSError, ValueError):
    """A file that cannot be read or written, or that is not what it should be."""
