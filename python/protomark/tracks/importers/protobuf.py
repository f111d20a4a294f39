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
        if byte < 128:
            reader.offset = at
            return value & 0xFFFF_FFFF_FFFF_FFFF
        shift += 7
    reader.fail("a number does not end")


def fields(reader: Reader, length: int | None = None) -> Iterator[tuple[int, int, Any]]:
    """Number, wire type and value of each field of a message of `length` bytes; None: of the rest.

    Values of `VARINT` are int, those of `FIXED32` and `FIXED64` bytes. Of `BYTES`, as messages
    are, the value is their length, and the caller reads or skips them before the next field.
    """
    data = reader.data
    end = len(data) if length is None else reader.offset + length
    while reader.offset < end:
        key = data[reader.offset]
        if key < 128:
            reader.offset += 1
        else:
            key = varint(reader)
        number, wire = key >> 3, key & 7
        if not 0 < number <= _MAX_NUMBER:
            reader.fail(f"a field has the number {number}")
        if wire == BYTES:
            size = varint(reader)
            begin = reader.offset
            if size > end - begin:
                reader.fail(f"{size:,} bytes end after their message")
            yield number, wire, size
            if reader.offset not in (begin, begin + size):
                reader.fail("a message ends elsewhere")
            reader.offset = begin + size
        elif wire == VARINT:
            yield number, wire, varint(reader)
        elif wire in _SIZES:
            begin = reader.skip(_SIZES[wire])
            yield number, wire, data[begin : reader.offset]
        else:
            reader.fail(f"a field has the unknown wire type {wire}")
    if reader.offset != end:
        reader.fail("a field ends after its message")
