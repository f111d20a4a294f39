"""Reads MessagePack (github.com/msgpack/msgpack/blob/master/spec.md), lists of records as columns.

A map's millions of numbers as Python objects would take ten times the file. Records of a list are
alike, so they are compared with the first one and read by NumPy.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

_MAX_DEPTH = 16
# Marker -> type of the number that follows it, for NumPy and for struct.
_NUMBERS = {
    **{0xCA: (">f4", ">f"), 0xCB: (">f8", ">d")},
    **{0xCC: (">u1", ">B"), 0xCD: (">u2", ">H"), 0xCE: (">u4", ">I"), 0xCF: (">u8", ">Q")},
    **{0xD0: (">i1", ">b"), 0xD1: (">i2", ">h"), 0xD2: (">i4", ">i"), 0xD3: (">i8", ">q")},
}
_STRUCTS = {marker: struct.Struct(form) for marker, (_, form) in _NUMBERS.items()}
_CONSTANTS = {0xC0: None, 0xC2: False, 0xC3: True}
# Markers of texts and bytes, arrays, maps -> bytes of their length.
_TEXTS = {0xD9: 1, 0xDA: 2, 0xDB: 4}
_BYTES = {0xC4: 1, 0xC5: 2, 0xC6: 4}
_ARRAYS = {0xDC: 2, 0xDD: 4}
_MAPS = {0xDE: 2, 0xDF: 4}

Leaf = tuple[str | int, ...]  # the keys and places that lead to a number of a record


@dataclass
class _Field:
    """A number of a record."""

    leaf: Leaf
    at: int  # byte in the record
    kind: str
    mask: int  # the bits of its first byte that are a marker

    @property
    def size(self) -> int:
        return int(self.kind[-1])


class Unpacker:
    """A place in MessagePack data.

    Args:
        data: all bytes.
        path: the file that they are from, for errors.
    """

    def __init__(self, data: bytes, path: Path) -> None:
        self.data, self.path, self.at = data, path, 0

    def fail(self, what: str) -> NoReturn:
        """Raise ValueError: `what` is wrong, in this file, at this byte."""
        raise ValueError(f"{self.path}, byte {self.at:,}: {what}: copy the file anew")

    def map_keys(self) -> Iterator[str]:
        """The keys of a map; whoever asks for the next one has read the value of the last."""
        for _ in range(self._length(0x80, _MAPS, "map", 2)):
            key = self.value()
            if not isinstance(key, str):
                self.fail(f"a key is {str(key)[:40]!r}, not a text")
            yield key

    def match(self, pattern: re.Pattern[bytes]) -> re.Match[bytes] | None:
        """What a pattern finds here, which is then read; None if it does not fit."""
        if found := pattern.match(self.data, self.at):
            self.at = found.end()
        return found

    def value(self, depth: int = 0) -> Any:
        """The next value, of None, bool, int, float, str, bytes, list and dict."""
        marker = self._peek()
        if marker < 0x80 or marker >= 0xE0:
            self.at += 1
            return marker if marker < 0x80 else marker - 256
        if form := _STRUCTS.get(marker):
            return form.unpack_from(self.data, self._skip(1 + form.size) + 1)[0]
        if marker in _CONSTANTS:
            self.at += 1
            return _CONSTANTS[marker]
        if marker & 0xE0 == 0xA0 or marker in _TEXTS:
            try:
                return self._bytes(marker & 0x1F if marker < 0xC0 else None, _TEXTS).decode()
            except UnicodeDecodeError:
                self.fail("a text is not UTF-8")
        if marker in _BYTES:
            return self._bytes(None, _BYTES)
        if depth == _MAX_DEPTH:
            self.fail("the data is nested too deeply")
        if marker & 0xF0 == 0x90 or marker in _ARRAYS:
            items: list[Any] = []
            for _ in range(self._length(0x90, _ARRAYS, "list")):
                # Most are -1: keypoints of no landmark.
                if self.data[self.at : self.at + 1] == b"\xff":
                    self.at += 1
                    items.append(-1)
                else:
                    items.append(self.value(depth + 1))
            return items
        out = {}
        for _ in range(self._length(0x80, _MAPS, "map", 2)):
            key = self.value(depth + 1)
            if not isinstance(key, (str, int)):
                self.fail("a key is no text")
            out[key] = self.value(depth + 1)
        return out

    def table(self) -> tuple[list[Leaf], NDArray[np.float64]]:
        """A list of records, which are maps, lists or numbers that hold the same numbers.

        Returns:
            k leaves, and the numbers of n records (n, k) float64.
        """
        count = self._length(0x90, _ARRAYS, "list")
        leaves: list[Leaf] = []
        parts: list[NDArray[np.float64]] = []
        while count:
            begin = self.at
            fields = {field.leaf: field for field in self._record((), begin)}
            leaves = leaves or list(fields)
            if not leaves or set(fields) != set(leaves):
                self.fail("the records of a list do not hold the same numbers")
            run = self._alike(begin, self.at - begin, count, list(fields.values()))
            rows = self._rows(begin, self.at - begin, run)
            columns = [
                np.ascontiguousarray(rows[:, f.at : f.at + f.size]).view(f.kind)[:, 0]
                for f in (fields[leaf] for leaf in leaves)
            ]
            parts.append(np.column_stack(columns).astype(np.float64))
            self.at = begin + rows.size
            count -= run
        return leaves, np.concatenate(parts) if parts else np.zeros((0, 0))

    def _record(self, leaf: Leaf, start: int) -> Iterator[_Field]:
        """The numbers of the next record, which begins at `start`."""
        marker = self._peek()
        if len(leaf) == _MAX_DEPTH:
            self.fail("the data is nested too deeply")
        if marker & 0xF0 == 0x80 or marker in _MAPS:
            for key in self.map_keys():
                yield from self._record((*leaf, key), start)
        elif marker & 0xF0 == 0x90 or marker in _ARRAYS:
            for i in range(self._length(0x90, _ARRAYS, "list")):
                yield from self._record((*leaf, i), start)
        elif marker in _NUMBERS:
            kind = _NUMBERS[marker][0]
            yield _Field(leaf, self._skip(1 + int(kind[-1])) + 1 - start, kind, 0)
        elif marker < 0x80:
            yield _Field(leaf, self._skip(1) - start, ">u1", 0x80)
        elif marker >= 0xE0:
            yield _Field(leaf, self._skip(1) - start, ">i1", 0xE0)
        else:
            self.fail("a record of a list holds something else than numbers")

    def _alike(self, begin: int, size: int, limit: int, fields: list[_Field]) -> int:
        """How many records, from the one at `begin` on, differ in their numbers only."""
        first = self._rows(begin, size, 1)
        fixed = np.full(size, 0xFF, np.uint8)
        for field in fields:
            fixed[field.at : field.at + field.size] = field.mask
        limit = min(limit, (len(self.data) - begin) // size)
        run, step = 1, 16
        while run < limit:
            step = min(4 * step, limit - run)
            rows = self._rows(begin + run * size, size, step)
            differ = (((rows ^ first) & fixed) != 0).any(axis=1)
            if differ.any():
                return run + int(differ.argmax())
            run += step
        return run

    def _rows(self, begin: int, size: int, count: int) -> NDArray[np.uint8]:
        return np.frombuffer(self.data, np.uint8, count * size, begin).reshape(count, size)

    def _peek(self) -> int:
        if self.at >= len(self.data):
            self.fail("the file ends here, but more should follow")
        return self.data[self.at]

    def _skip(self, count: int) -> int:
        """Pass bytes over; returns where they began."""
        begin = self.at
        if count > len(self.data) - begin:
            self.fail(f"{count:,} bytes should follow, but {len(self.data) - begin:,} do")
        self.at += count
        return begin

    def _bytes(self, length: int | None, lengths: dict[int, int]) -> bytes:
        if length is None:
            length = self._long(lengths[self.data[self.at]])
        else:
            self.at += 1
        begin = self._skip(length)
        return self.data[begin : begin + length]

    def _long(self, size: int) -> int:
        begin = self._skip(1 + size) + 1
        return int.from_bytes(self.data[begin : begin + size], "big")

    def _length(self, short: int, lengths: dict[int, int], name: str, each: int = 1) -> int:
        """How many items a map or list has, which what follows has room for."""
        marker = self._peek()
        if marker & 0xF0 == short:
            self.at += 1
            count = marker & 0x0F
        elif marker in lengths:
            count = self._long(lengths[marker])
        else:
            self.fail(f"a {name} should be here")
        if count * each > len(self.data) - self.at:
            self.fail(f"{count:,} items of a {name} should follow: the file is cut off or broken")
        return count
