"""What a map in the making keeps of descriptors, and how frames are matched with it."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.features.descriptors import descriptor_kind
from protomark.mapping.frame import Ids
from protomark.mapping.options import MappingOptions
from protomark.maps.build import chosen_dim
from protomark.maps.info import matching_bytes
from protomark.match_calibration import NO_DISTANCE, MatchCalibration
from protomark.matching import MIN_PROBABILITY


class Memory(ABC):
    """What a map keeps of descriptors, and how a frame is matched with it.

    Descriptors are encoded once per frame; all other calls take the encoded form. Protomark's maps
    have `Prototypes` for a memory; `protomark evaluate-mapping` compares it with others.

    Attributes:
        ratio: limit on the ratio of the two distances that `search` returns, for a memory without
            calibration.
        guided_ratio: limit on the ratio of the two smallest `distances` to landmarks that project
            near the keypoint.
        max_distance: limit on the distance to a landmark that projects near the keypoint, as a
            share of the median distance between keypoints and other landmarks.
    """

    ratio = 0.85**2
    guided_ratio = 0.9
    max_distance = 0.75

    @abstractmethod
    def encode(self, descriptors: NDArray[np.uint8]) -> NDArray[Any]:
        """Encode descriptors (n, B) uint8 as (n, width), the form that is compared."""

    @abstractmethod
    def add(self, ids: Ids, encoded: NDArray[Any]) -> None:
        """Add observations; new ids are new landmarks."""

    @abstractmethod
    def subtract(self, ids: Ids, encoded: NDArray[Any]) -> None:
        """Remove observations that were added before, exactly."""

    @abstractmethod
    def merge_landmarks(self, into: Ids, source: Ids) -> None:
        """Merge each source landmark into the one in `into`."""

    @abstractmethod
    def remove(self, ids: Ids) -> None:
        """Remove landmarks."""

    @abstractmethod
    def search(
        self, encoded: NDArray[Any], threads: int = 1, among: Ids | None = None
    ) -> tuple[Ids, NDArray[np.int32]]:
        """The two nearest landmarks of each descriptor, exactly: ids and distances (q, 2).

        If there is none, the id is -1 and the distance 2^31 - 1. Euclidean distances are squared.

        Args:
            encoded: (q, width).
            threads: threads to search on; the result is the same.
            among: ids of the landmarks to search, ascending; None: all.
        """

    @abstractmethod
    def distances(self, encoded: NDArray[Any], rows: Ids, ids: Ids) -> NDArray[np.float32]:
        """Distance (p,) of each row `rows[i]` of `encoded` from landmark `ids[i]`."""

    @abstractmethod
    def contains(self, ids: Ids) -> NDArray[np.bool_]:
        """Whether the memory holds each landmark."""

    @property
    @abstractmethod
    def bytes(self) -> int:
        """Bytes that matching needs for all landmarks, without positions."""

    def accepted(self, distances: NDArray[np.int32]) -> Ids:
        """Rows of distances (q, 2) whose nearest landmark is accepted, the clearest first."""
        nearest, second = distances.T
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.where(second > 0, nearest / second, 1.0)
        return clearest_rows(nearest, ratio, self.ratio)

    def expected(self, distances: NDArray[np.int32]) -> float:
        """How many of accepted matches with distances (q, 2) should be right; 0: unknown."""
        return 0.0


def clearest_rows(nearest: NDArray[np.int32], ambiguity: NDArray[np.floating], limit: float) -> Ids:
    """Rows (k,) whose ambiguity (q,) is below a limit, by ambiguity and then by distance."""
    rows = np.flatnonzero((nearest < NO_DISTANCE) & (ambiguity < limit))
    return rows[np.lexsort((nearest[rows], ambiguity[rows]))]


class Prototypes(Memory):
    """Prototypes of landmarks, and no descriptors (the paper's method)."""

    def __init__(self, encoder: pm.Encoder, dim: int, appearance_bits: int = 0) -> None:
        self.encoder, self.dim = encoder, chosen_dim(encoder, dim)
        self.map = pm.PrototypeMap(encoder, dim, appearance_bits)
        self.calibration: MatchCalibration | None = None
        with contextlib.suppress(ValueError):
            self.calibration = encoder.match_calibration(dim)

    def encode(self, descriptors: NDArray[np.uint8]) -> NDArray[Any]:
        """See `Memory.encode`."""
        return self.encoder.encode(descriptors, self.dim)

    def add(self, ids: Ids, encoded: NDArray[Any]) -> None:
        """See `Memory.add`: Eq. 1 and Eq. 2 of the paper."""
        self.map.add_codes(ids, encoded)

    def subtract(self, ids: Ids, encoded: NDArray[Any]) -> None:
        """See `Memory.subtract`; landmarks whose sums were halved keep what they lack."""
        try:
            self.map.subtract_codes(ids, encoded)
        except ValueError:
            for i in range(len(ids)):
                with contextlib.suppress(ValueError):
                    self.map.subtract_codes(ids[i : i + 1], encoded[i : i + 1])

    def merge_landmarks(self, into: Ids, source: Ids) -> None:
        """See `Memory.merge_landmarks`."""
        self.map.merge_landmarks(into, source)

    def remove(self, ids: Ids) -> None:
        """See `Memory.remove`."""
        self.map.remove(ids)

    def search(
        self, encoded: NDArray[Any], threads: int = 1, among: Ids | None = None
    ) -> tuple[Ids, NDArray[np.int32]]:
        """See `Memory.search`."""
        return self.map.search_codes(encoded, k=2, threads=threads, among=among)

    def distances(self, encoded: NDArray[Any], rows: Ids, ids: Ids) -> NDArray[np.float32]:
        """See `Memory.distances`."""
        return np.sqrt(self.map.distances(ids, encoded[rows]).astype(np.float32))

    def contains(self, ids: Ids) -> NDArray[np.bool_]:
        """See `Memory.contains`."""
        return np.isin(ids, self.map.ids)

    @property
    def bytes(self) -> int:
        """See `Memory.bytes`: as in a sealed map without loss."""
        return round(matching_bytes(self.map) * len(self.map))

    def accepted(self, distances: NDArray[np.int32]) -> Ids:
        """See `Memory.accepted`; the probability decides if the encoder was calibrated."""
        if self.calibration is None:
            return super().accepted(distances)
        ambiguity = 1 - self.calibration.probability(distances)
        return clearest_rows(distances[:, 0], ambiguity, 1 - MIN_PROBABILITY)

    def expected(self, distances: NDArray[np.int32]) -> float:
        """See `Memory.expected`: the sum of their probabilities."""
        if self.calibration is None or not len(distances):
            return 0.0
        return float(self.calibration.probability(distances).sum())

    def use(self, scene: pm.PrototypeMap) -> None:
        """Continue with a saved map.

        Raises:
            ValueError: it was made with another encoder or other dimensions.
        """
        if scene.dim != self.dim or scene.encoder.identity != self.encoder.identity:
            raise ValueError("the map was made with another encoder or other dimensions")
        self.map = scene


def prototypes_for(options: MappingOptions) -> Prototypes:
    """An empty memory of prototypes.

    Raises:
        ValueError: the encoder is for another descriptor, or lacks that number of dimensions.
    """
    kind = descriptor_kind(options.descriptor)
    encoder = pm.Encoder.load(options.encoder or kind.name)
    if encoder.descriptor != kind.name or encoder.bits != kind.bits:
        raise ValueError(
            f"encoder '{encoder.name}' is for {encoder.descriptor} of {encoder.bits // 8} bytes, "
            f"not for {kind.name}"
        )
    return Prototypes(encoder, options.dim, options.appearance_bits)
