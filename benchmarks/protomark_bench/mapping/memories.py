"""Memories to compare prototypes with: all descriptors, or one medoid per landmark."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark import hamming_search
from protomark.baselines.binary import medoid
from protomark.baselines.support import Support
from protomark.features.descriptors import descriptor_kind
from protomark.mapping.memory import Memory
from protomark.mapping.options import MappingOptions

# Rows of removed landmarks are dropped once they are this share of all rows.
_MAX_REMOVED_SHARE = 0.25
_PAIRS = 4096
_SET_BITS = np.array([bin(byte).count("1") for byte in range(256)], np.uint8)


class Descriptors(Memory):
    """Every descriptor of every landmark: the traditional way."""

    # Hamming distances are squared Euclidean ones, so their ratios are squares.
    ratio, guided_ratio, max_distance = 0.8, 0.85, 0.6

    @classmethod
    def of(cls, options: MappingOptions) -> Descriptors:
        """An empty memory for a map with these options."""
        return cls(descriptor_kind(options.descriptor).bytes)

    def __init__(self, width: int) -> None:
        self._descriptors = np.zeros((0, width), np.uint8)
        self._owners = np.zeros(0, np.int64)
        self._sorted: tuple[NDArray[np.int64], NDArray[np.uint8]] | None = None
        self._padded: tuple[NDArray[np.uint8], NDArray[np.uint64]] | None = None

    def encode(self, descriptors: NDArray[np.uint8]) -> NDArray[Any]:
        """See `Memory.encode`."""
        return descriptors

    def add(self, ids: NDArray[np.int64], encoded: NDArray[Any]) -> None:
        """See `Memory.add`."""
        self._sorted = None
        self._descriptors = np.concatenate([self._descriptors, encoded])
        self._owners = np.concatenate([self._owners, ids])

    def subtract(self, ids: NDArray[np.int64], encoded: NDArray[Any]) -> None:
        """See `Memory.subtract`."""
        self._sorted = None
        order = np.argsort(self._owners, kind="stable")
        sorted_owners = self._owners[order]
        first, last = (np.searchsorted(sorted_owners, ids, side) for side in ("left", "right"))
        for owner, descriptor, a, b in zip(ids, encoded, first, last, strict=True):
            rows = order[a:b]
            same = (self._descriptors[rows] == descriptor).all(1) & (self._owners[rows] == owner)
            if not same.any():
                raise ValueError(f"landmark {owner} has no such observation")
            self._owners[rows[np.argmax(same)]] = -1
        self._compact()

    def merge_landmarks(self, into: NDArray[np.int64], source: NDArray[np.int64]) -> None:
        """See `Memory.merge_landmarks`."""
        self._sorted = None
        order = np.argsort(source)
        row = np.minimum(np.searchsorted(source[order], self._owners), max(len(source) - 1, 0))
        if len(source):
            merged = source[order][row] == self._owners
            self._owners[merged] = into[order][row[merged]]

    def remove(self, ids: NDArray[np.int64]) -> None:
        """See `Memory.remove`."""
        self._sorted = None
        self._owners[np.isin(self._owners, ids)] = -1
        self._compact()

    def _compact(self) -> None:
        existing = self._owners >= 0
        if len(existing) and 1 - existing.mean() > _MAX_REMOVED_SHARE:
            self._owners, self._descriptors = self._owners[existing], self._descriptors[existing]

    def table(self) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """Ascending owners (n,) and descriptors (n, B) that matching compares."""
        if self._sorted is None:
            order = np.argsort(self._owners, kind="stable")
            order = order[np.searchsorted(self._owners[order], 0) :]
            self._sorted = self._owners[order], self._descriptors[order]
        return self._sorted

    def search(
        self, encoded: NDArray[Any], threads: int = 1, among: NDArray[np.int64] | None = None
    ) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """See `Memory.search`."""
        owners, descriptors = self.table()
        if among is not None:
            chosen = np.isin(owners, among)
            owners, descriptors = owners[chosen], descriptors[chosen]
        return hamming_search(encoded, descriptors, k=2, landmarks=owners, threads=threads)

    def distances(
        self, encoded: NDArray[Any], rows: NDArray[np.int64], ids: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """See `Memory.distances`."""
        if not len(rows):
            return np.zeros(0, np.float32)
        owners, _ = self.table()
        per_id = np.bincount(owners, minlength=int(ids.max()) + 1)
        counts = per_id[ids]
        starts = np.cumsum(counts) - counts
        pair = np.repeat(np.arange(len(ids)), counts)
        row = np.arange(len(pair)) + np.repeat((np.cumsum(per_id) - per_id)[ids] - starts, counts)
        words, others = _words(encoded), self._table_words()
        bits = np.empty(len(pair), np.int32)
        for a in range(0, len(pair), _PAIRS):
            b = a + _PAIRS
            bits[a:b] = _set_bits(words[rows[pair[a:b]]] ^ others[row[a:b]])
        return np.minimum.reduceat(bits, starts).astype(np.float32)

    def _table_words(self) -> NDArray[np.uint64]:
        descriptors = self.table()[1]
        if self._padded is None or self._padded[0] is not descriptors:
            self._padded = descriptors, _words(descriptors)
        return self._padded[1]

    def contains(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """See `Memory.contains`."""
        return np.isin(ids, self._owners)

    @property
    def bytes(self) -> int:
        """Bytes of all descriptors, without their assignment to landmarks."""
        return int((self._owners >= 0).sum()) * int(self._descriptors.shape[1])


class Medoids(Descriptors):
    """The medoid of each landmark's descriptors, which ORB-SLAM matches.

    All descriptors are kept, as an update of a medoid needs them, but `bytes` counts the medoids
    only, which matching needs.
    """

    # A medoid is farther from a new view than the nearest of all descriptors: with their limits,
    # mapping with medoids loses the camera in the middle of `hololens`.
    ratio, guided_ratio, max_distance = 0.9, 0.92, 0.75

    def __init__(self, width: int) -> None:
        super().__init__(width)
        self._medoids: dict[int, NDArray[np.uint8]] = {}
        self._changed: set[int] = set()
        self._table: tuple[NDArray[np.int64], NDArray[np.uint8]] | None = None

    def add(self, ids: NDArray[np.int64], encoded: NDArray[Any]) -> None:
        """See `Memory.add`."""
        super().add(ids, encoded)
        self._changed.update(ids.tolist())

    def subtract(self, ids: NDArray[np.int64], encoded: NDArray[Any]) -> None:
        """See `Memory.subtract`."""
        super().subtract(ids, encoded)
        self._changed.update(ids.tolist())

    def merge_landmarks(self, into: NDArray[np.int64], source: NDArray[np.int64]) -> None:
        """See `Memory.merge_landmarks`."""
        super().merge_landmarks(into, source)
        self._changed.update(into.tolist(), source.tolist())

    def remove(self, ids: NDArray[np.int64]) -> None:
        """See `Memory.remove`."""
        super().remove(ids)
        self._changed.update(ids.tolist())

    def table(self) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """See `Descriptors.table`."""
        self._update()
        if self._table is None:
            ids = np.array(sorted(self._medoids), np.int64)
            rows = [self._medoids[i] for i in ids.tolist()]
            width = self._descriptors.shape[1]
            self._table = ids, np.array(rows, np.uint8).reshape(-1, width)
        return self._table

    def _update(self) -> None:
        if not self._changed:
            return
        self._table = None
        changed = np.array(sorted(self._changed), np.int64)
        self._changed.clear()
        for i in changed.tolist():
            self._medoids.pop(i, None)
        rows = np.isin(self._owners, changed)
        if rows.any():
            found = medoid(Support(self._owners[rows], self._descriptors[rows]))
            self._medoids.update(zip(found.landmarks.tolist(), found.descriptors, strict=True))

    @property
    def bytes(self) -> int:
        """Bytes of the medoids only."""
        self._update()
        return len(self._medoids) * int(self._descriptors.shape[1])


def _words(descriptors: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Pad (n, bytes) uint8 with zeros to (n, ceil(bytes / 8)) uint64."""
    count, width = descriptors.shape
    padded = np.zeros((count, -(-width // 8) * 8), np.uint8)
    padded[:, :width] = descriptors
    return padded.view(np.uint64)


def _set_bits(words: NDArray[np.uint64]) -> NDArray[np.int32]:
    """Number of set bits (n,) in each row of (n, words)."""
    if hasattr(np, "bitwise_count"):
        return np.asarray(np.bitwise_count(words).sum(1, dtype=np.int32))
    return np.asarray(_SET_BITS[words.view(np.uint8)].sum(1, dtype=np.int32))
