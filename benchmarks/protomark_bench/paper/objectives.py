"""The paper's two objectives: triplet networks (Eq. 4) and prototypical networks (Eq. 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from protomark.training.sampling import Views, random_views

MARGIN = 1.0
MAX_VIEWS = 6
# Share of a landmark's views that are queries; at least one is.
QUERY_SHARE = 1 / 3
# Keeps the gradient of a distance finite if two embeddings are equal.
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
    repeated = np.flatnonzero(views.counts >= 2)
    if len(views) < 2 or not len(repeated):
        raise ValueError(f"{views.name}: there are no two landmarks to draw a triplet from")
    chosen = rng.choice(repeated, min(count, len(repeated)), replace=False, shuffle=False)
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
        margin: margin of the hinge.
    """

    def distance(a: Tensor, b: Tensor) -> Tensor:
        return ((a - b).square().sum(1) + _TINY).sqrt()

    return torch.relu(distance(anchor, positive) - distance(anchor, negative) + margin).mean()


@dataclass(frozen=True)
class Episode:
    """Landmarks of one sequence as classes, each with a support and a query set.

    Attributes:
        rows: (n,) int64, rows of `Views.descriptors`.
        classes: (n,) int64, 0..c-1 ascending, the class of each row.
        is_query: (n,) bool; every class has rows of both kinds.
    """

    rows: NDArray[np.int64]
    classes: NDArray[np.int64]
    is_query: NDArray[np.bool_]


def draw_episode(views: Views, classes: int, rng: np.random.Generator) -> Episode:
    """Up to `classes` random landmarks with two or more views, up to six views of each.

    Raises:
        ValueError: fewer than two landmarks have two views.
    """
    repeated = np.flatnonzero(views.counts >= 2)
    if len(repeated) < 2:
        raise ValueError(f"{views.name}: an episode needs two landmarks with two views")
    chosen = rng.choice(repeated, min(classes, len(repeated)), replace=False, shuffle=False)
    rows, group, rank = random_views(views, chosen, MAX_VIEWS, rng)
    queries = np.maximum((np.bincount(group) * QUERY_SHARE).astype(np.int64), 1)
    return Episode(rows, group, rank < queries[group])


def prototypical_loss(embeddings: Tensor, classes: Tensor, is_query: Tensor) -> Tensor:
    """Mean negative log-probability of the queries' classes, a scalar.

    A softmax over negative distances to the means of the support sets classifies a query. The paper
    does not state the distance; this is the squared Euclidean one of Snell et al. (2017), for which
    the mean is the point closest to a support set (a Bregman divergence). The loss is a mean where
    the paper has a sum, so that the learning rate does not depend on the size of an episode.

    Args:
        embeddings: (n, k) float.
        classes: (n,) int64, 0..c-1.
        is_query: (n,) bool; every class has rows of both kinds.
    """
    support, target = embeddings[~is_query], classes[is_query]
    of_support = classes[~is_query]
    count = of_support.bincount()
    total = support.new_zeros(len(count), support.shape[1]).index_add(0, of_support, support)
    prototypes = total / count[:, None]
    query = embeddings[is_query]
    # -|q - p|^2 without |q|^2, which cancels in the softmax.
    logits = 2 * query @ prototypes.T - prototypes.square().sum(1)
    return functional.cross_entropy(logits, target)
