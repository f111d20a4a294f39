"""Reads a tracks file piece by piece, from a disk or from object storage."""

from __future__ import annotations

import json
import struct
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.distributed.folder import file_system, shown
from protomark.tracks.file import ARRAYS, header_fields

# What safetensors calls the types of the arrays.
_TYPES = {"F32": np.float32, "F64": np.float64, "I32": np.int32, "I64": np.int64, "U8": np.uint8}
_MAX_HEADER = 1 << 27
# Rows of an array that are read at a time to go through all of it.
BLOCK = 1 << 18


class TracksFile:
    """A tracks file of which the arrays stay where they are.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not a tracks file, or is cut off.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self._fs, self._path = file_system(url)
        try:
            self._size = int(self._fs.info(self._path)["size"])
            with self._open() as file:
                (length,) = struct.unpack("<Q", file.read(8))
                if length > min(_MAX_HEADER, self._size):
                    raise ValueError("no safetensors file")
                header = json.loads(file.read(length))
            # The attributes of `Tracks` that are no arrays.
            self.fields = header_fields(header.pop("__metadata__", {}))
            self._arrays = {name: self._array(header, name, 8 + length) for name in ARRAYS}
        except FileNotFoundError:
            raise FileNotFoundError(f"{shown(url)}: no such tracks file") from None
        except (KeyError, TypeError, struct.error, UnicodeDecodeError, ValueError) as error:
            told = "broken" if isinstance(error, (KeyError, TypeError)) else str(error)
            raise ValueError(f"{shown(url)}: not a tracks file, or a broken one ({told})") from None

    def _array(
        self, header: dict[str, Any], name: str, start: int
    ) -> tuple[Any, tuple[int, ...], int]:
        found, (dtype, shape) = header[name], ARRAYS[name]
        begin, end = found["data_offsets"]
        rows = tuple(int(n) for n in found["shape"])
        size = int(np.prod(rows)) * np.dtype(dtype).itemsize
        if _TYPES.get(found["dtype"]) is not dtype or len(rows) != len(shape):
            raise ValueError(f"{name} is {found['dtype']} {rows}")
        if not (begin >= 0 and end - begin == size and start + end <= self._size):
            raise ValueError(f"{name} is cut off")
        return dtype, rows, start + begin

    def _open(self) -> Any:
        return self._fs.open(self._path, "rb", block_size=1 << 20)

    def rows(self, name: str) -> int:
        """Number of rows of an array."""
        return self._arrays[name][1][0]

    def read(self, name: str, start: int, stop: int) -> NDArray[Any]:
        """Rows of an array; what lies beyond its end is left out."""
        dtype, shape, offset = self._arrays[name]
        stop = min(stop, shape[0])
        row = int(np.prod(shape[1:])) * np.dtype(dtype).itemsize
        with self._open() as file:
            file.seek(offset + start * row)
            content = file.read((stop - start) * row)
        return np.frombuffer(content, dtype).reshape(-1, *shape[1:])

    @cached_property
    def descriptor_bytes(self) -> int:
        """Bytes per descriptor."""
        return self._arrays["descriptors"][1][1]
