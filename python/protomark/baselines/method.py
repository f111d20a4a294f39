"""The interface of compared methods."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Method(ABC):
    """A map that finds the landmarks of descriptors.

    Attributes:
        bytes_per_landmark: all that matching needs, including the count, without the position.
    """

    bytes_per_landmark: float

    @abstractmethod
    def match(
        self, descriptors: NDArray[Any], threads: int = 1
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """The two nearest distinct landmarks of each descriptor.

        Args:
            descriptors: (q, b), as those of the map.
            threads: threads to search on.

        Returns:
            Landmark ids (q, 2) int64, nearest first, ties to the smaller id, -1 where there is
            none, and distances (q, 2) float32, infinite where there is none. Distances are those
            that the method searches by, Hamming or Euclidean, and compare within one method only.
        """
