"""Reads Boost's binary serialization archives, as far as ORB-SLAM3's need it."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from protomark.tracks.importers.binary import Reader

SIGNATURE = b"serialization::archive"
_BINARY = struct.pack("<Q", len(SIGNATURE)) + SIGNATURE
_TEXT = b"%d %s" % (len(SIGNATURE), SIGNATURE)
# Sizes of int, long, float, double, and a 1 that tells the order of bytes: 64-bit little-endian.
_MACHINE = bytes([4, 8, 4, 8, 1, 0, 0, 0])
_POINTER = struct.Struct("<hI")


def is_archive(head: bytes) -> bool:
    """Whether a file that begins so is a Boost archive, binary or text."""
    return head.startswith((_BINARY, _TEXT))


class Archive(Reader):
    """A binary archive: what precedes an object, and the containers of the standard library."""

    def __init__(self, data: bytes, path: Path) -> None:
        super().__init__(data, path)
        if data.startswith(_TEXT):
            raise ValueError(f"{path} is a text archive: save it as a binary one")
        self.expect(self.take(len(_BINARY)) == _BINARY, "this is no Boost archive")
        self.version = self.u16()
        if self.take(len(_MACHINE)) != _MACHINE:
            raise ValueError(
                f"{path} was written on a machine with other sizes or order of bytes than x86-64: "
                "save it on one like that"
            )
        self._types: set[str] = set()  # those that have occurred
        self._classes: dict[str, int] = {}  # ids of classes of objects behind pointers
        self._objects = 0  # number of objects behind pointers

    def text(self) -> str:
        """A std::string."""
        return bytes(self.take(self.count())).decode(errors="replace")

    def flags(self, count: int) -> list[int]:
        """Values of bool, which are 0 or 1."""
        values = list(self.take(count))
        self.expect(max(values, default=0) <= 1, "a truth value is neither 0 nor 1")
        return values

    def begin(self, *types: str) -> None:
        """What precedes an object: on the first of its type, whether it is tracked, and version."""
        for name in types:
            if name not in self._types:
                self._types.add(name)
                self.expect(not any(self.take(5)), f"{name} is of an unknown version")

    def pointer(self, name: str, known: dict[str, int]) -> bool:
        """What precedes an object of class `name` behind a pointer; False: it does not follow.

        It is null, or the same object has been read before. `known` has numbers of classes.
        """
        number = self.i16()
        if number == -1:
            return False
        if name not in self._classes:
            fits = known.get(name, number) == number and number not in self._classes.values()
            self.expect(fits and number >= 0, f"class {number} should be {name}")
            self._classes[name] = number
            tracking, version = self.u8(), self.u32()
            self.expect(tracking == 1 and not version, f"{name} is of an unknown version")
        self.expect(number == self._classes[name], f"class {number} should be {name}")
        object_id = self.u32()
        self.expect(
            object_id <= self._objects, f"object {object_id} of class {name} skips a number"
        )
        new = object_id == self._objects
        self._objects += new
        return new

    def object(self, name: str, known: dict[str, int]) -> None:
        """What precedes an object that must follow its pointer."""
        self.expect(self.pointer(name, known), f"a {name} is missing or occurs twice")

    def numbers(self, dtype: DTypeLike) -> NDArray[Any]:
        """A std::vector of numbers."""
        return self.array(dtype, self.count(np.dtype(dtype).itemsize))

    def items(self, name: str, size: int) -> range:
        """What precedes the objects, of at least `size` bytes each, of a vector or map `name`."""
        self.begin(name)
        number = self.count(size)
        self.skip(4)  # their version
        return range(number)

    def pairs(self, key: str, value: str) -> memoryview:
        """The bytes of a std::map of numbers: each key, then its value."""
        size = struct.calcsize(f"<{key}{value}")
        number = len(self.items(f"map of {key} to {value}", size))
        if number:
            self.begin(f"pair of {key} and {value}")
        return self.take(number * size)

    def skip_vectors(self, count: int) -> None:
        """Pass over `count` vectors of 64-bit numbers."""
        words = self.data[self.offset : self.offset + len(self) // 8 * 8].cast("Q")
        at = 0
        try:
            for _ in range(count):
                at += words[at] + 1
        except IndexError:
            at = len(words) + 1
        self.skip(8 * at)
