"""Read a map and answer queries from docs/format.md alone, with NumPy and no Protomark.

    python examples/02_read_map_without_protomark.py scene.pmk

A reader in another language takes the same steps. The answers are exactly those of Protomark.
"""

import struct
import sys
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

ENCODER, LEARNING_MAP, SEALED_MAP = 1, 2, 3
BITS, UINT8, FLOAT32 = 0, 1, 2  # what descriptors consist of


def sections(data: bytes, *kinds: int) -> dict[str, bytes]:
    """Check and return the sections of a file of one of these kinds."""
    if len(data) < 64 or data[:8] != b"PROTOMRK":
        raise ValueError("not a Protomark file")
    version, kind, size, count, crc = struct.unpack_from("<IIQII", data, 8)
    end = 64 + 32 * count
    if version != 1 or kind not in kinds or size != len(data) or count > 64 or end > size:
        raise ValueError(f"its version is {version}, its kind {kind}, or it is cut off")
    if zlib.crc32(data[:28] + bytes(4) + data[32:end]) != crc:
        raise ValueError("its header does not match its checksum")
    found = {}
    for name, offset, length, crc, _ in struct.iter_unpack("<8sQQII", data[64:end]):
        content = data[offset : offset + length]
        if len(content) != length or zlib.crc32(content) != crc:
            raise ValueError(f"section {name!r} does not match its checksum")
        found[name.rstrip(b"\0").decode()] = content
    return found  # a reader ignores those that it does not know


def bit_numbers(content: Any, count: int, width: int) -> Any:
    """Unpack `count` numbers of `width` bits, least significant bits first."""
    bits = np.unpackbits(content, count=count * width, bitorder="little").reshape(count, width)
    return (bits.astype(np.int64) << np.arange(width)).sum(1)


def learning_sums(parts: dict[str, bytes], k: int) -> Any:
    """Unpack the sums of rows of k numbers, (m, k): each eight numbers of w bits take w bytes."""
    counts, content = (np.frombuffer(parts[name], "u1") for name in ("counts", "sums"))
    eights = -(-k // 8)
    spare = bit_numbers(np.frombuffer(parts["spare"], "u1"), len(counts) * eights, 2)
    widths = np.repeat(8 + np.ceil(np.log2(counts)).astype(int), eights) - spare
    starts, sums = np.cumsum(widths) - widths, np.empty((len(widths), 8), np.int64)
    for width in np.unique(widths):  # all of this width together
        same = np.flatnonzero(widths == width)
        packed = content[starts[same, None] + np.arange(width)]
        values = 1 << np.arange(width)
        values[-1] *= -1  # two's complement
        bits = np.unpackbits(packed, axis=1, bitorder="little").reshape(-1, 8, width)
        sums[same] = bits @ values
    return sums.reshape(len(counts), 8 * eights)[:, :k]


def learning_rows(parts: dict[str, bytes], n: int) -> tuple[Any, Any]:
    """Return the number of rows of each of n landmarks, and the appearance of each row."""
    if "appbits" not in parts:
        return np.ones(n, int), np.zeros(n, int)
    bits = int.from_bytes(parts["appbits"], "little")
    marked = bit_numbers(np.frombuffer(parts["appear"], "u1"), len(parts["counts"]), bits + 1)
    last_rows = np.flatnonzero(marked >> bits)
    return np.diff(last_rows, prepend=-1), marked % (1 << bits)


def landmark_ids(parts: dict[str, bytes], n: int) -> Any:
    """Return the ids of a map's n landmarks: in blocks of 128, or 0 ... n - 1."""
    if "idblocks" not in parts:
        return np.arange(n)
    gaps, ids = np.frombuffer(parts["idgaps"], np.uint8), np.arange(n) % 128
    for i, (first_id, word_and_width) in enumerate(struct.iter_unpack("<qQ", parts["idblocks"])):
        word, width = divmod(word_and_width, 64)
        block = ids[128 * i : 128 * i + 128]
        block += first_id + bit_numbers(gaps[8 * word :], len(block), width)
    return ids


def texts(content: bytes) -> Iterator[str]:
    """Yield the texts of a map's metadata: name, text, name, text, ..."""
    while content:
        end = 4 + int.from_bytes(content[:4], "little")
        yield content[4:end].decode()
        content = content[end:]


class Encoder:
    """The integer network of a model; layers are (weights, bias, multipliers, shift, table)."""

    def __init__(self, data: bytes) -> None:
        parts = sections(data, ENCODER)
        network = BytesIO(parts["network"][4:])  # behind the scale
        # The words of each width, (subspaces, 256, width).
        self.codebooks, at = {}, 0
        while at < len(parts.get("codebook", b"")):
            width, subspaces = struct.unpack_from("<II", parts["codebook"], at)
            size = subspaces * 256 * width
            words = np.frombuffer(parts["codebook"], "i1", size, at + 8)
            self.codebooks[width] = words.reshape(subspaces, 256, width).astype(np.int64)
            at += 8 + size

        def take(dtype: str, count: int) -> Any:
            return np.frombuffer(network.read(count * np.dtype(dtype).itemsize), dtype)

        self.dims = take("<u4", take("<u4", 1)[0]).tolist()
        self.layers = []
        for _ in range(take("<u4", 1)[0]):
            inputs, outputs, shift = take("<u4", 3).tolist()
            bias, multipliers, table = take("<i4", outputs), take("<i4", outputs), take("u1", 256)
            weights = take("i1", outputs * inputs).reshape(outputs, inputs).astype(np.int64)
            self.layers.append((weights, bias, multipliers, shift, table))
        self.input, self.input_scale = struct.unpack("<If", network.read() or bytes(8))

    def encode(self, descriptors: Any, dim: int) -> Any:
        """Encode descriptors (n, bits / 8) or vectors (n, d) as codes (n, dim), integers."""
        x = descriptors
        if self.input == BITS:
            x = np.unpackbits(x, axis=1, bitorder="little")
        elif self.input == FLOAT32:
            x = np.clip(np.rint(x * np.float32(self.input_scale)), -127, 127) + 128
        x = x.astype(np.int64)
        for weights, bias, multipliers, shift, table in self.layers:
            t = ((x @ weights.T + bias) * multipliers + (1 << (shift - 1))) >> shift
            x = table[np.clip(t, -128, 127) + 128].astype(np.int64)
        return np.clip(t, -127, 127)[:, :dim]


class Map:
    """A map of n landmarks and m prototypes of k numbers.

    Attributes:
        ids: (n,) landmark ids, ascending.
        prototypes: (m, k) integers.
        landmarks: (m,) the landmark id of each prototype.
        counts: (m,) observations of each prototype of a learning map, None of a sealed one.
        positions: (n, 3), NaN where there is none.
        metadata: texts by name.
    """

    def __init__(self, data: bytes) -> None:
        parts = sections(data, LEARNING_MAP, SEALED_MAP)
        self.encoder = Encoder(parts["encoder"])
        n, k, *origin = struct.unpack("<QQ3d", parts["shape"])
        pairs = texts(parts.get("metadata", b""))
        self.metadata = dict(zip(pairs, pairs, strict=True))
        learning = "sums" in parts
        self.ids = landmark_ids(parts, n)
        sealed_rows = np.frombuffer(parts.get("rows", bytes([1]) * n), "u1")
        rows = learning_rows(parts, n)[0] if learning else sealed_rows
        self.landmarks = np.repeat(self.ids, rows)
        self.counts: Any = None
        if learning:
            self.counts = np.frombuffer(parts["counts"], "u1")
            sums = learning_sums(parts, k)
            count = self.counts[:, None].astype(np.int64)
            self.prototypes = np.sign(sums) * ((2 * abs(sums) + count) // (2 * count))
        else:
            self.prototypes = sealed_prototypes(
                parts, self.encoder.codebooks, n, k, len(self.landmarks)
            )
        self.positions = np.full((n, 3), np.nan)
        if "position" in parts:
            dtype, none, step = "<f8" if learning else "<f4", np.nan, np.ones(3)
            if "steps" in parts:  # 16-bit positions
                dtype, none, step = "<u2", 65535, np.frombuffer(parts["steps"], "<f8")
            xyz = np.frombuffer(parts["position"], dtype).reshape(n, 3)
            self.positions = np.where(xyz == none, np.nan, origin + step * xyz)

    def search(self, descriptors: Any) -> tuple[Any, Any]:
        """Return the nearest landmark of each descriptor and the squared distance to it."""
        codes, p = self.encoder.encode(descriptors, self.prototypes.shape[1]), self.prototypes
        squared = (codes**2).sum(1)[:, None] - 2 * codes @ p.T + (p**2).sum(1)
        nearest = squared.argmin(1)  # of equals the first, which has the smallest id
        return self.landmarks[nearest], squared.min(1).astype(np.int32)


def sealed_prototypes(
    parts: dict[str, bytes], codebooks: dict[int, Any], n: int, k: int, m: int
) -> Any:
    """Return the m prototypes of a sealed map by landmark, (m, k)."""
    if "width" in parts:  # words of a codebook
        width = int.from_bytes(parts["width"], "little")
        b = np.frombuffer(parts["protos"], "u1").reshape(-1, k // width, 16)
        words = b.transpose(0, 2, 1).reshape(-1, k // width)
        p = codebooks[width][np.arange(k // width), words].reshape(-1, k)
    else:
        p = np.frombuffer(parts["protos"], "i1").astype(np.int64).reshape(-1, -(-k // 4), 16, 4)
        p = p.transpose(0, 2, 1, 3).reshape(16 * len(p), -1)[:, :k]
    if "owners" not in parts:
        return p[:m]
    # With an index, prototypes are sorted by inverted list; rows that landmark n owns are padding.
    owners = bit_numbers(np.frombuffer(parts["owners"], "u1"), len(p), max(n, 1).bit_length())
    return p[np.argsort(owners, kind="stable")[:m]]


if __name__ == "__main__":
    if len(sys.argv) != 2 or sys.argv[1].startswith("-"):
        sys.exit(__doc__)
    scene = Map(Path(sys.argv[1]).read_bytes())
    print(f"{len(scene.ids)} landmarks, prototypes {scene.prototypes.shape}, {scene.metadata}")
