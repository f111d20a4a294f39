"""What a map keeps of its landmarks' descriptors, and how frames are matched with it."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.baselines.binary import medoid
from protomark.baselines.support import Support
from protomark.features.descriptors import descriptor_kind
from protomark.match_calibration import MatchCalibration

if TYPE_CHECKING:
    from protomark.mapping.options import MappingOptions

# Rows of removed landmarks are dropped when they are this share of all.
_MAX_REMOVED_SHARE = 0.25
_CHUNK = 256
_PAIRS = 4096
_SET_BITS = np.array([bin(byte).count("1") for byte in range(256)], np.uint8)


class Memory(ABC):
    """What a map keeps of descriptors, and how a frame is matched with it.

    Descriptors are encoded once per frame; all other calls take the encoded form, which for binary
    memories is the descriptor itself.

    Attributes:
        euclidean: whether distances are Euclidean, of codes, and not Hamming.
    """

    euclidean: bool

    @abstractmethod
    def encode(self, descriptors: NDArray[np.uint8]) -> NDArray[Any]:
        """Encode descriptors (n, bytes) uint8 as (n, width), the form that is compared."""

    @abstractmethod
    def add(self, ids: NDArray[np.int64], encoded: NDArray[Any]) -> None:
        """Add observations: unknown ids are new landmarks."""

    @abstractmethod
    def subtract(self, ids: NDArray[np.int64], encoded: NDArray[Any]) -> None:
        """Take back observations that were added before, exactly."""

    @abstractmethod
    def merge_landmarks(self, into: NDArray[np.int64], source: NDArray[np.int64]) -> None:
        """Merge each source landmark into the one in `into`."""

    @abstractmethod
    def remove(self, ids: NDArray[np.int64]) -> None:
        """Remove landmarks."""

    @abstractmethod
    def search(
        self, encoded: NDArray[Any], threads: int = 1, among: NDArray[np.int64] | None = None
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """The two nearest landmarks of each descriptor, exactly: ids (q, 2), -1 for none, and distances.

        Args:
            encoded: (q, width).
            threads: threads to search on; the result is the same.
            among: landmarks to search, ascending; None: all.
        """

    @abstractmethod
    def distances(
        self, encoded: NDArray[Any], rows: NDArray[np.int64], ids: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """Distances (p,) between row `rows[i]` of `encoded` and landmark `ids[i]`."""

    @abstractmethod
    def contains(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of these landmarks the memory holds."""

    @property
    @abstractmethod
    def bytes(self) -> int:
        """Bytes that matching needs for all landmarks, positions apart."""

    @abstractmethod
    def arrays(self) -> dict[str, NDArray[Any]]:
        """What must be saved beside the map file to resume later; nothing for prototypes."""

    @abstractmethod
    def restore(self, arrays: dict[str, NDArray[Any]], scene: pm.PrototypeMap | None) -> None:
        """Restore the arrays that `arrays` returned and, for prototypes, the saved map."""


class Prototypes(Memory):
    """One prototype per landmark, and no descriptors (the paper's method)."""

    euclidean = True

    def __init__(self, encoder: pm.Encoder, dim: int) -> None:
        if dim not in encoder.dims:
            raise ValueError(
                f"--dim {dim}: encoder '{encoder.name}' has codes of "
                f"{', '.join(map(str, encoder.dims))} dimensions"
            )
        self.encoder, self.dim = encoder, dim
        self.map = pm.PrototypeMap(encoder, dim)
        self.calibration: MatchCalibration | None = None
        with contextlib.suppress(ValueError):
            self.calibration = MatchCalibration.of(encoder, dim)

    def encode(self, descriptors: NDArray[np.uint8]) -> NDArray[Any]:
        """See `Memory.encode`."""
        return self.encoder.encode(descriptors, self.dim)

    def add(self, ids: NDArray[np.int64], encoded: NDArray[Any]) -> None:
        """Eq. 1 and Eq. 2 of the paper."""
        self.map.add_codes(ids, encoded)

    def subtract(self, ids: NDArray[np.int64], encoded: NDArray[Any]) -> None:
        """See `Memory.subtract`; a landmark halved at 255 observations may keep its share."""
        try:
            self.map.remove_codes(ids, encoded)
        except ValueError:
            for i in range(len(ids)):
                with contextlib.suppress(ValueError):
                    self.map.remove_codes(ids[i : i + 1], encoded[i : i + 1])

    def merge_landmarks(self, into: NDArray[np.int64], source: NDArray[np.int64]) -> None:
        """See `Memory.merge_landmarks`."""
        self.map.merge(into, source)

    def remove(self, ids: NDArray[np.int64]) -> None:
        """See `Memory.remove`."""
        self.map.discard(ids)

    def search(
        self, encoded: NDArray[Any], threads: int = 1, among: NDArray[np.int64] | None = None
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """See `Memory.search`."""
        if among is None:
            return self.map.search_codes(encoded, k=2, threads=threads)
        # Sums of integers far below 2^24: exact in float32.
        codes, places = encoded.astype(np.float32), self._rounded(among)
        ids = np.full((len(codes), 2), -1, np.int64)
        distances = np.full((len(codes), 2), np.inf, np.float32)
        if not len(among):
            return ids, distances
        lengths = (places * places).sum(1)
        for at in range(0, len(codes), _CHUNK):
            some = codes[at : at + _CHUNK]
            squares = (some * some).sum(1)[:, None] + lengths - 2 * some @ places.T
            for k in range(min(2, len(among))):
                best = np.argmin(squares, axis=1)
                rows = np.arange(len(some))
                ids[at : at + _CHUNK, k] = among[best]
                distances[at : at + _CHUNK, k] = np.sqrt(squares[rows, best])
                squares[rows, best] = np.inf
        return ids, distances

    def distances(
        self, encoded: NDArray[Any], rows: NDArray[np.int64], ids: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """See `Memory.distances`."""
        if not len(rows):
            return np.zeros(0, np.float32)
        at = np.zeros(int(ids.max()) + 1, np.int64)
        at[ids] = 1
        known = np.flatnonzero(at)
        at[known] = np.arange(len(known))
        codes, places = encoded.astype(np.float32), self._rounded(known)
        squares = np.empty(len(rows), np.float32)
        # Pieces that fit into the cache are several times faster.
        for a in range(0, len(rows), _PAIRS):
            b = a + _PAIRS
            difference = places[at[ids[a:b]]] - codes[rows[a:b]]
            squares[a:b] = np.einsum("pd,pd->p", difference, difference)
        return np.sqrt(squares)

    def contains(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """See `Memory.contains`."""
        return np.isin(ids, self.map.ids)

    def _rounded(self, ids: NDArray[np.int64]) -> NDArray[np.float32]:
        """Prototypes as search compares them: to integers, halves away from zero."""
        means = self.map.prototype(ids)
        return np.sign(means) * np.floor(np.abs(means) + np.float32(0.5))

    @property
    def bytes(self) -> int:
        """As in a sealed map: one byte per dimension and one for the count."""
        return len(self.map) * (self.dim + 1)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """See `Memory.arrays`."""
        return {}

    def restore(self, arrays: dict[str, NDArray[Any]], scene: pm.PrototypeMap | None) -> None:
        """See `Memory.restore`."""
        if scene is None:
            raise ValueError("a memory of prototypes needs its map file")
        if scene.dim != self.dim or scene.encoder.identity != self.encoder.identity:
            raise ValueError("the map was made with another encoder or other dimensions")
        self.map = scene


class Descriptors(Memory):
    """Every descriptor of every landmark: the traditional way."""

    euclidean = False

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
        at = np.minimum(np.searchsorted(source[order], self._owners), max(len(source) - 1, 0))
        if len(source):
            hit = source[order][at] == self._owners
            self._owners[hit] = into[order][at[hit]]

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
        """Owners (n,), ascending, and descriptors (n, bytes) that matching compares with."""
        if self._sorted is None:
            order = np.argsort(self._owners, kind="stable")
            order = order[np.searchsorted(self._owners[order], 0) :]
            self._sorted = self._owners[order], self._descriptors[order]
        return self._sorted

    def search(
        self, encoded: NDArray[Any], threads: int = 1, among: NDArray[np.int64] | None = None
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """See `Memory.search`."""
        owners, descriptors = self.table()
        if among is not None:
            chosen = np.isin(owners, among)
            owners, descriptors = owners[chosen], descriptors[chosen]
        ids, distances = pm.hamming_search(
            encoded, descriptors, k=2, landmarks=owners, threads=threads
        )
        return ids, np.where(ids >= 0, distances, np.inf).astype(np.float32)

    def distances(
        self, encoded: NDArray[Any], rows: NDArray[np.int64], ids: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """See `Memory.distances`."""
        if not len(rows):
            return np.zeros(0, np.float32)
        owners, _ = self.table()
        many = np.bincount(owners, minlength=int(ids.max()) + 1)
        counts = many[ids]
        starts = np.cumsum(counts) - counts
        pair = np.repeat(np.arange(len(ids)), counts)
        row = np.arange(len(pair)) + np.repeat((np.cumsum(many) - many)[ids] - starts, counts)
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
        """Bytes of all descriptors, without what assigns them to landmarks."""
        return int((self._owners >= 0).sum()) * int(self._descriptors.shape[1])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """See `Memory.arrays`."""
        return {"memory_descriptors": self._descriptors, "memory_owners": self._owners}

    def restore(self, arrays: dict[str, NDArray[Any]], scene: pm.PrototypeMap | None) -> None:
        """See `Memory.restore`."""
        self._descriptors = arrays["memory_descriptors"]
        self._owners = arrays["memory_owners"]
        self._sorted = None


class Medoids(Descriptors):
    """Of each landmark the descriptor that is closest to its others, as ORB-SLAM matches.

    To update a medoid takes all descriptors, so they are kept; `bytes` counts the medoids, which
    matching needs.
    """

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

    def restore(self, arrays: dict[str, NDArray[Any]], scene: pm.PrototypeMap | None) -> None:
        """See `Memory.restore`."""
        super().restore(arrays, scene)
        self._medoids.clear()
        self._table = None
        self._changed = set(self._owners[self._owners >= 0].tolist())

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


MEMORIES = ("prototypes", "medoids", "descriptors")


def make_memory(options: MappingOptions) -> Memory:
    """The memory that the options ask for.

    Raises:
        ValueError: the encoder is for another descriptor, or lacks that number of dimensions.
    """
    kind = descriptor_kind(options.descriptor)
    if options.memory == "descriptors":
        return Descriptors(kind.bytes)
    if options.memory == "medoids":
        return Medoids(kind.bytes)
    encoder = pm.Encoder.load(options.encoder or kind.name)
    if encoder.descriptor != kind.name or encoder.bits != kind.bits:
        raise ValueError(
            f"encoder '{encoder.name}' is for {encoder.descriptor} with {encoder.bits} bits, "
            f"not for {kind.name}"
        )
    return Prototypes(encoder, options.dim)
