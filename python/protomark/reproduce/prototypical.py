"""Prototypical networks: Eq. 3 of the paper, after Snell et al. (2017)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from protomark.training.sampling import Views, random_views

MAX_VIEWS = 6
# Of the views of a landmark, this share is queries, at least one.
QUERY_SHARE = 1 / 3


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
    often = np.flatnonzero(views.counts >= 2)
    if len(often) < 2:
        raise ValueError(f"{views.name}: no two landmarks with two views to make an episode of")
    chosen = rng.choice(often, min(classes, len(often)), replace=False, shuffle=False)
    rows, group, rank = random_views(views, chosen, MAX_VIEWS, rng)
    queries = np.maximum((np.bincount(group) * QUERY_SHARE).astype(np.int64), 1)
    return Episode(rows, group, rank < queries[group])


def prototypical_loss(embeddings: Tensor, classes: Tensor, is_query: Tensor) -> Tensor:
    """Mean negative log-probability of the queries' own classes, a scalar.

    A query is classified by a softmax over minus the distances to the means of the support sets.
    The paper leaves the distance open; this is the squared Euclidean one of Snell et al., for
    which the mean is the point closest to a support set (a Bregman divergence). The loss is the
    mean where the paper writes the sum, so that a learning rate means the same for any episode.

    Args:
        embeddings: (n, k) float.
        classes: (n,) int64, 0..c-1.
        is_query: (n,) bool; every class has rows of both kinds.
    """
    support, target = embeddings[~is_query], classes[is_query]
    of = classes[~is_query]
    count = of.bincount()
    total = support.new_zeros(len(count), support.shape[1]).index_add(0, of, support)
    prototypes = total / count[:, None]
    query = embeddings[is_query]
    # -|q - p|^2 without |q|^2, which is the same for all classes and cancels in the softmax.
    logits = 2 * query @ prototypes.T - prototypes.square().sum(1)
    return functional.cross_entropy(logits, target)
