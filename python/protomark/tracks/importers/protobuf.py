"""Reads protobuf messages without their schema (https://protobuf.dev/programming-guides/encoding)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from protomark.tracks.importers.binary import Reader

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
_SIZES = {FIXED64: 8, FIXED32: 4}
_MAX_NUMBER = (1 << 29) - 1  # of a field


def varint(reader: Reader) -> int:
    """The next number of up to 64 bits, 7 of which are in a byte."""
    data, at = reader.data, reader.offset
    value = shift = 0
    while at < len(data) and shift < 64:
        byte = data[at]
        at += 1
        value |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            reader.offset = at
            return value & 0xFFFF_FFFF_FFFF_FFFF
    reader.fail("a number does not end")


def fields(reader: Reader, length: int | None = None) -> Iterator[tuple[int, int, Any]]:
    """Number, wire type and value of each field of a message of `length` bytes; None: of the rest.

    Values are int of `VARINT`, else bytes. Of `BYTES`, as messages are, it is their length: the
    caller reads or skips them before the next field.
    """
    end = len(reader.data) if length is None else reader.offset + length
    while reader.offset < end:
        key = varint(reader)
        number, wire = key >> 3, key & 7
        reader.expect(0 < number <= _MAX_NUMBER, f"a field has the number {number}")
        if wire == VARINT:
            yield number, wire, varint(reader)
        elif wire == BYTES:
            size = varint(reader)
            reader.expect(size <= end - reader.offset, f"{size:,} bytes end after their message")
            after = reader.offset + size
            yield number, wire, size
            reader.expect(reader.offset in (after - size, after), "a message ends elsewhere")
            reader.offset = after
        elif wire in _SIZES:
            yield number, wire, bytes(reader.take(_SIZES[wire]))
        else:
            reader.fail(f"a field has the unknown wire type {wire}")
    reader.expect(reader.offset == end, "a field ends after its message")
