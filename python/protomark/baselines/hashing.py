"""Signs of projections of the mean of a landmark's descriptors, searched by Hamming distance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.baselines.binary import DescriptorMap
from protomark.baselines.linear import Projection, principal_components
from protomark.baselines.method import Method
from protomark.baselines.support import Support
from protomark.features.descriptors import InputKind, numbers_of

# Means that the rotation of iterative quantisation is learned from, and its passes (the paper's).
MAX_MEANS = 16_384
PASSES = 50


@dataclass(eq=False)
class SignMap(Method):
    """One binary code per landmark; queries are projected and coded alike."""

    projection: Projection
    codes: DescriptorMap
    kind: InputKind  # what the descriptors are

    @classmethod
    def of(cls, support: Support, projection: Projection) -> SignMap:
        """The codes of the landmarks' means."""
        codes = _signs(support.means, projection)
        return cls(projection, DescriptorMap(codes, support.ids, codes.shape[1]), support.kind)

    def __post_init__(self) -> None:
        self.bytes_per_landmark = self.codes.bytes_per_landmark

    def match(
        self, descriptors: NDArray[Any], threads: int = 1
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """See `Method.match`."""
        values = numbers_of(descriptors, self.kind).astype(np.float32)
        return self.codes.match(_signs(values, self.projection), threads)


def random_hyperplanes(support: Support, size: int) -> SignMap:
    """LSH, `size` bytes: the sides of random hyperplanes through the mean of all descriptors.

    Charikar, "Similarity estimation techniques from rounding algorithms", STOC 2002.
    """
    rng = np.random.default_rng(support.seed)
    planes = rng.standard_normal((support.width, 8 * size), dtype=np.float32)
    return SignMap.of(support, Projection(support.moments.mean.astype(np.float32), planes))


def iterative_quantization(support: Support, size: int) -> SignMap:
    """ITQ, `size` bytes: signs of principal components, rotated to be near to the values.

    Gong and Lazebnik, "Iterative quantization: a Procrustean approach to learning binary codes",
    CVPR 2011. The rotation is learned from the means of landmarks that are drawn at random.
    """
    components = principal_components(support.moments).truncated(8 * size)
    rng = np.random.default_rng(support.seed)
    means = support.means
    if len(means) > MAX_MEANS:
        means = means[np.sort(rng.choice(len(means), MAX_MEANS, replace=False))]
    values = (means - components.mean) @ components.matrix
    rotation, _ = np.linalg.qr(rng.standard_normal((values.shape[1],) * 2))
    rotation = rotation.astype(np.float32)
    for _ in range(PASSES):
        signs = np.where(values @ rotation >= 0, np.float32(1), np.float32(-1))
        # The rotation that brings the values nearest to their signs (orthogonal Procrustes).
        left, _, right = np.linalg.svd(values.T @ signs)
        rotation = left @ right
    return SignMap.of(support, Projection(components.mean, components.matrix @ rotation))


def _signs(values: NDArray[np.float32], projection: Projection) -> NDArray[np.uint8]:
    """Packed signs (n, k / 8) of projected values (n, width)."""
    projected = (values - projection.mean) @ projection.matrix
    return np.packbits(projected >= 0, axis=1, bitorder="little")
