"""Reads numbers and arrays from bytes that nobody vouches for."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import DTypeLike, NDArray

_U8, _U16, _U32, _U64 = (struct.Struct(f"<{c}") for c in "BHIQ")
_I8, _I16, _I32, _I64 = (struct.Struct(f"<{c}") for c in "bhiq")
_F32, _F64 = struct.Struct("<f"), struct.Struct("<d")


class Reader:
    """A place in little-endian bytes; whatever would end beyond them is a ValueError.

    Args:
        data: all bytes.
        path: the file that they are from, for errors.
    """

    remedy = "the file is cut off or broken, save it again"

    def __init__(self, data: bytes | memoryview, path: Path) -> None:
        self.data = memoryview(data).cast("B")
        self.path = path
        self.offset = 0
        self.where = ""  # what is being read, for errors

    def __len__(self) -> int:
        """Bytes that remain."""
        return len(self.data) - self.offset

    def fail(self, what: str) -> NoReturn:
        """Raise ValueError: `what` is wrong, in this file, at this byte."""
        where = f"{self.where}, " if self.where else ""
        raise ValueError(f"{self.path}, {where}byte {self.offset:,}: {what}: {self.remedy}")

    def expect(self, fits: Any, what: str) -> None:
        """Fail unless something `fits`."""
        if not fits:
            self.fail(what)

    def skip(self, count: int) -> int:
        """Pass `count` bytes over; returns where they began."""
        begin = self.offset
        if not 0 <= count <= len(self.data) - begin:
            self.fail(f"{count:,} bytes should follow, but {len(self):,} do")
        self.offset = begin + count
        return begin

    def take(self, count: int) -> memoryview:
        """The next `count` bytes, not copied."""
        begin = self.skip(count)
        return self.data[begin : begin + count]

    def unpack(self, form: struct.Struct) -> tuple[Any, ...]:
        """The next numbers, as a compiled `struct` has them."""
        try:
            numbers = form.unpack_from(self.data, self.offset)
        except struct.error:
            self.skip(form.size)  # which fails
            raise
        self.offset += form.size
        return numbers

    def array(self, dtype: DTypeLike, *shape: int) -> NDArray[Any]:
        """The next numbers as an array of this shape, not copied and not writable."""
        kind = np.dtype(dtype)
        count = 1 if min(shape, default=0) >= 0 else -1
        for side in shape:
            count *= side
        begin = self.skip(count * kind.itemsize)
        return np.frombuffer(self.data, kind, count, begin).reshape(shape)

    def count(self, size: int = 1, form: struct.Struct = _U64) -> int:
        """A number of items of at least `size` bytes each, which must fit into what remains."""
        number: int = self.unpack(form)[0]
        if not 0 <= number * size <= len(self):
            self.fail(f"{number:,} items should follow in {len(self):,} bytes")
        return number

    def u8(self) -> int:
        """An unsigned byte."""
        return self.unpack(_U8)[0]

    def u16(self) -> int:
        """An unsigned 16-bit number."""
        return self.unpack(_U16)[0]

    def u32(self) -> int:
        """An unsigned 32-bit number."""
        return self.unpack(_U32)[0]

    def u64(self) -> int:
        """An unsigned 64-bit number."""
        return self.unpack(_U64)[0]

    def i8(self) -> int:
        """A signed byte."""
        return self.unpack(_I8)[0]

    def i16(self) -> int:
        """A signed 16-bit number."""
        return self.unpack(_I16)[0]

    def i32(self) -> int:
        """A signed 32-bit number."""
        return self.unpack(_I32)[0]

    def i64(self) -> int:
        """A signed 64-bit number."""
        return self.unpack(_I64)[0]

    def f32(self) -> float:
        """A 32-bit number."""
        return self.unpack(_F32)[0]

    def f64(self) -> float:
        """A 64-bit number."""
        return self.unpack(_F64)[0]
