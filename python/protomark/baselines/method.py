"""What every compared method can do once its map is built."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray


class Method(ABC):
    """A map that was built in one way or another, and answers which landmark a descriptor is of.

    Attributes:
        bytes_per_landmark: all that matching needs, the count included, the 3D position not.
    """

    bytes_per_landmark: float

    @abstractmethod
    def match(
        self, descriptors: NDArray[np.uint8], threads: int = 1
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """The two nearest distinct landmarks of each descriptor.

        Args:
            descriptors: (q, bits / 8) uint8.
            threads: how many threads may search.

        Returns:
            (q, 2) int64 landmark ids, nearest first, ties to the smaller id, -1 where there is
            none, and (q, 2) float32 distances, infinite where there is none. Distances are
            Hamming or Euclidean, whichever the method searches by: they order and compare
            within one method only.
        """
