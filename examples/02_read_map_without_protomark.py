"""Read a model or map and answer queries from docs/format.md alone, with NumPy and no Protomark.

    python examples/02_read_map_without_protomark.py scene.pmk

A reader in another language does what stands here. It answers exactly as Protomark does.
"""

import struct
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np

ENCODER, OPEN_MAP, SEALED_MAP = 1, 2, 3


def sections(data: bytes, kinds: tuple[int, ...]) -> dict[str, bytes]:
    """The sections of a file, bounds and checksums checked."""
    if len(data) < 64 or data[:8] != b"PROTOMRK":
        raise ValueError("not a Protomark file")
    version, kind, size, count, crc = struct.unpack_from("<IIQII", data, 8)
    if not 1 <= version <= 4 or kind not in kinds:
        raise ValueError(f"a file of version {version} and kind {kind}")
    end = 64 + 32 * count
    if size != len(data) or count > 64 or end > size:
        raise ValueError("cut off, or its header is broken")
    if zlib.crc32(data[:28] + bytes(4) + data[32:end]) != crc:
        raise ValueError("its header does not match its checksum")
    found: dict[str, bytes] = {}
    for i in range(count):
        name, offset, length, crc = struct.unpack_from("<8sQQI", data, 64 + 32 * i)
        if offset % 64 or offset < end or offset + length > size:
            raise ValueError("its section table is broken")
        end = offset + length
        if zlib.crc32(data[offset:end]) != crc:
            raise ValueError(f"section {name!r} does not match its checksum")
        found[name.rstrip(b"\0").decode()] = data[offset:end]
    return found  # a reader takes those that it knows


def array(content: bytes, dtype: str, *shape: int) -> Any:
    """A section as numbers, of exactly this shape."""
    if len(content) != np.dtype(dtype).itemsize * int(np.prod(shape)):
        raise ValueError("a section has the wrong size")
    return np.frombuffer(content, dtype).reshape(shape)


def bit_numbers(content: Any, count: int, width: int) -> Any:
    """Numbers of `width` bits one after the other, least significant bits first."""
    bits = np.unpackbits(content, count=count * width, bitorder="little").reshape(count, width)
    return (bits.astype(np.int64) << np.arange(width)).sum(1)


def texts(content: bytes) -> dict[str, str]:
    """Pairs of texts: what a map says of itself."""
    found = []
    while content:
        (size,) = struct.unpack_from("<I", content)
        found.append(content[4 : 4 + size].decode())
        content = content[4 + size :]
    return dict(zip(found[::2], found[1::2], strict=True))


def sealed_ids(parts: dict[str, bytes], n: int) -> Any:
    """The ids of a sealed map's n landmarks: runs of blocks, plain in old files, or 0 ... n - 1."""
    if "idblocks" not in parts:
        return array(parts["ids"], "<i8", n) if "ids" in parts else np.arange(n)
    blocks = array(parts["idblocks"], "<i8", -(-n // 128), 2)
    rests = np.frombuffer(parts["idrests"], np.uint8)
    ids = np.arange(n) % 128
    for i, (base, place) in enumerate(blocks.tolist()):
        block = ids[128 * i : 128 * i + 128]
        block += base + bit_numbers(rests[place // 64 * 8 :], len(block), place % 64)
    return ids


class Encoder:
    """The integer network; layers are (weights, bias, multipliers, shift, table)."""

    def __init__(self, data: bytes) -> None:
        network = sections(data, (ENCODER,))["network"]
        self.scale, count = struct.unpack_from("<fI", network)
        self.dims = np.frombuffer(network, "<u4", count, 8).tolist()
        (depth,) = struct.unpack_from("<I", network, 8 + 4 * count)
        at = 12 + 4 * count
        self.layers = []
        for _ in range(depth):
            inputs, outputs, shift = struct.unpack_from("<III", network, at)
            bias = np.frombuffer(network, "<i4", outputs, at + 12)
            multipliers = np.frombuffer(network, "<i4", outputs, at + 12 + 4 * outputs)
            table = np.frombuffer(network, np.uint8, 256, at + 12 + 8 * outputs)
            at += 268 + 8 * outputs
            weights = np.frombuffer(network, np.int8, outputs * inputs, at)
            at += outputs * inputs
            self.layers.append((weights.reshape(outputs, inputs), bias, multipliers, shift, table))

    def encode(self, descriptors: Any, dim: int) -> Any:
        """(n, bits / 8) uint8 to (n, dim) integers."""
        x = np.unpackbits(descriptors, axis=1, bitorder="little").astype(np.int64)
        for weights, bias, multipliers, shift, table in self.layers:
            sums = x @ weights.T.astype(np.int64) + bias
            t = (sums * multipliers + (1 << (shift - 1))) >> shift
            x = table[np.clip(t, -128, 127) + 128].astype(np.int64)
        return np.clip(t, -127, 127)[:, :dim]


class Map:
    """Prototypes (m, k), rounded, `landmarks` (m,) ids of theirs; counts, positions, metadata."""

    def __init__(self, data: bytes) -> None:
        parts = sections(data, (OPEN_MAP, SEALED_MAP))
        self.encoder = Encoder(parts["encoder"])
        n, k, *origin = struct.unpack("<QQ3d", parts["shape"])
        self.metadata = texts(parts.get("metadata", b""))
        is_open = "sums" in parts
        self.ids = array(parts["ids"], "<i8", n) if is_open else sealed_ids(parts, n)
        rows = array(parts["rows"], "<u4" if is_open else "u1", n) if "rows" in parts else [1] * n
        self.landmarks = np.repeat(self.ids, rows)
        m = len(self.landmarks)
        if is_open:
            self.counts = array(parts["counts"], "u1", m)  # of each prototype
            sums = array(parts["sums"], "<i2", m, k).astype(np.int64)
            count = self.counts[:, None].astype(np.int64)
            self.prototypes = np.sign(sums) * ((2 * abs(sums) + count) // (2 * count))
        else:
            self.counts = array(parts["counts"], "u1", n)  # of each landmark
            blocks = -(-m // 16)
            if "cells" in parts:  # an index: rows cell after cell, each cell from a new block on
                rows = np.frombuffer(parts["cellrows"], "<u4").astype(np.int64)
                blocks = int((-(-rows // 16)).sum())
                order = np.frombuffer(parts["order"], np.uint8)
                order = bit_numbers(order, 16 * blocks, max(n, 1).bit_length())
            if "levels" in parts:  # 4 bits a number
                _, half_step = array(parts["levels"], "<u4", 2)
                b = array(parts["protos"], "u1", blocks, -(-k // 8), 16, 4)
                b = np.concatenate([b & 15, b >> 4], axis=3)
                p = int(half_step) * (2 * b.astype(np.int64) - 15)
            else:
                p = array(parts["protos"], "i1", blocks, -(-k // 4), 16, 4).astype(np.int64)
            p = p.transpose(0, 2, 1, 3).reshape(16 * blocks, -1)[:, :k]
            # By landmark; in an index, places with no landmark are padding.
            by_id = np.argsort(order, kind="stable") if "cells" in parts else np.arange(m)
            self.prototypes = p[by_id[:m]]
        self.positions = np.full((n, 3), np.nan)
        if "steps" in parts:
            cells = array(parts["position"], "<u2", n, 3)
            steps = array(parts["steps"], "<f8", 3)
            self.positions = np.where(cells == 65535, np.nan, origin + steps * cells)
        elif "position" in parts:
            self.positions = array(parts["position"], "<f8" if is_open else "<f4", n, 3) + origin

    def search(self, descriptors: Any) -> tuple[Any, Any]:
        """The nearest landmark of each descriptor, ties to the smaller id, and its distance."""
        codes = self.encoder.encode(descriptors, self.prototypes.shape[1])
        squared = (
            (codes**2).sum(1)[:, None] - 2 * codes @ self.prototypes.T + (self.prototypes**2).sum(1)
        )
        nearest = squared.argmin(1)  # the first: prototypes are sorted by id
        distances = np.take_along_axis(squared, nearest[:, None], 1)[:, 0]
        return self.landmarks[nearest], np.sqrt(distances.astype(np.float32))


if __name__ == "__main__":
    scene = Map(Path(sys.argv[1]).read_bytes())
    placed = np.isfinite(scene.positions).all(1).sum()
    prototypes, dim = scene.prototypes.shape
    print(f"{len(scene.ids)} landmarks, {placed} with a position; {prototypes} x {dim} numbers")
