"""Triplet networks: Eq. 4 of the paper, with negatives drawn at random."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from protomark.training.sampling import Views, random_views

MARGIN = 1.0
# Keeps the gradient of the distance finite where two embeddings are equal.
_TINY = 1e-12


def draw_triplets(views: Views, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Anchor, positive and negative of up to `count` landmarks that have two or more views.

    The negative is a random view of a random other landmark of the same sequence.

    Returns:
        (3, m) int64, rows of `views.descriptors`; m is less than `count` only if fewer landmarks
        have two views.

    Raises:
        ValueError: there are fewer than two landmarks, or none with two views.
    """
    often = np.flatnonzero(views.counts >= 2)
    if len(views) < 2 or not len(often):
        raise ValueError(f"{views.name}: no two landmarks to draw a triplet from")
    chosen = rng.choice(often, min(count, len(often)), replace=False, shuffle=False)
    rows, _, _ = random_views(views, chosen, 2, rng)
    other = (chosen + rng.integers(1, len(views), len(chosen))) % len(views)
    negative = views.starts[other] + rng.integers(0, views.counts[other])
    return np.stack([rows[0::2], rows[1::2], negative])


def triplet_loss(
    anchor: Tensor, positive: Tensor, negative: Tensor, margin: float = MARGIN
) -> Tensor:
    """Mean of max(d(anchor, positive) - d(anchor, negative) + margin, 0), a scalar.

    d is the Euclidean distance, not squared, as the paper defines it.

    Args:
        anchor: (m, k) float, embeddings.
        positive: (m, k) float, embeddings of other views of the anchors' landmarks.
        negative: (m, k) float, embeddings of views of other landmarks.
        margin: of the hinge.
    """
    near = _distance(anchor, positive)
    far = _distance(anchor, negative)
    return torch.relu(near - far + margin).mean()


def _distance(a: Tensor, b: Tensor) -> Tensor:
    return ((a - b).square().sum(1) + _TINY).sqrt()
