"""Reads and writes the container of docs/format.md without Protomark."""

from __future__ import annotations

import runpy
import zlib
from pathlib import Path
from typing import Any

# The reader that the documentation gives.
READER: dict[str, Any] = runpy.run_path(
    str(Path(__file__).parents[1] / "examples" / "02_read_map_without_protomark.py")
)

Section = tuple[str, bytes]

LEARNING_MAP, SEALED_MAP = 2, 3


def sections(data: bytes) -> list[Section]:
    found = []
    for i in range(int.from_bytes(data[24:28], "little")):
        entry = data[64 + 32 * i : 96 + 32 * i]
        begin, size = (int.from_bytes(entry[a : a + 8], "little") for a in (8, 16))
        found.append((entry[:8].rstrip(b"\0").decode(), data[begin : begin + size]))
    return found


def container(parts: list[Section], version: int = 1, kind: int = SEALED_MAP) -> bytes:
    """A file of these sections with right checksums."""
    table, body = b"", b""
    offset = -(-(64 + 32 * len(parts)) // 64) * 64
    start = offset
    for name, content in parts:
        table += name.encode().ljust(8, b"\0") + offset.to_bytes(8, "little")
        table += len(content).to_bytes(8, "little")
        table += zlib.crc32(content).to_bytes(4, "little") + bytes(4)
        body += content.ljust(-(-len(content) // 64) * 64, b"\0")
        offset = start + len(body)
    head = b"PROTOMRK" + version.to_bytes(4, "little") + kind.to_bytes(4, "little")
    head += offset.to_bytes(8, "little") + len(parts).to_bytes(4, "little")
    crc = zlib.crc32(head + bytes(36) + table)
    return (head + crc.to_bytes(4, "little") + bytes(32) + table).ljust(start, b"\0") + body
