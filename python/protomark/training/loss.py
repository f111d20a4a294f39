"""The prototype loss: a view against the mean of its landmark's other views.

It trains the operation that the map performs. Every query of a batch is classified among all
prototypes of the batch by a softmax over negative squared distances (Eq. 3 of the paper); its own
landmark's prototype is the mean (Eq. 1) of the *other* views, as the map has never seen the query.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional


def leave_one_out(
    embeddings: Tensor, landmarks: Tensor, queries: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The queries of a batch, and the prototypes that they are held against.

    Args:
        embeddings: (n, k) float, one row a view.
        landmarks: (n,) int64, landmark of each row, numbered 0..m-1, each with a view.
        queries: (q,) int64, rows to classify; their landmarks have at least 2 views.

    Returns:
        (q, k) float32 queries; (q,) int64 their landmarks; (q, k) means of these landmarks' other
        views, as the support of a query is everything but itself; (m, k) means of all views of
        each landmark.
    """
    embeddings = embeddings.float()
    count = torch.bincount(landmarks)
    total = embeddings.new_zeros(len(count), embeddings.shape[1])
    total = total.index_add(0, landmarks, embeddings)
    query, target = embeddings[queries], landmarks[queries]
    own = (total[target] - query) / (count[target] - 1)[:, None]
    return query, target, own, total / count[:, None]


class PrototypeLoss(nn.Module):
    """Cross-entropy over the prototypes of a batch, averaged over nested prefixes.

    The first d numbers of an embedding are trained to serve alone, for every d in `dims`
    (Matryoshka), each with a learned temperature of its own as distances grow with d.

    Args:
        dims: lengths of the prefixes, the largest at most the embedding's length.
    """

    def __init__(self, dims: Sequence[int]) -> None:
        super().__init__()
        self.dims = tuple(dims)
        self.log_temperature = nn.Parameter(torch.tensor([math.log(d / 4) for d in self.dims]))

    def forward(
        self,
        embeddings: Tensor,
        landmarks: Tensor,
        queries: Tensor,
        dims: Sequence[int] | None = None,
    ) -> Tensor:
        """Loss of one batch.

        Args:
            embeddings: (n, k) float, one row a view.
            landmarks: (n,) int64, landmark of each row, numbered 0..m-1, each with a view.
            queries: (q,) int64, rows to classify; their landmarks have at least 2 views.
            dims: the prefixes that count this time, some of `self.dims`; None for all.

        Returns:
            Scalar: mean over prefixes and queries.
        """
        query, target, own, prototype = leave_one_out(embeddings, landmarks, queries)

        losses = []
        column = target[:, None]
        for d, log_temperature in zip(self.dims, self.log_temperature, strict=True):
            if dims is not None and d not in dims:
                continue
            # |q - p|^2 without |q|^2, which is the same for all prototypes and cancels.
            q, p, o = query[:, :d], prototype[:, :d], own[:, :d]
            inverse = torch.exp(-log_temperature)
            logits = torch.addmm(-inverse * p.square().sum(1), q, p.T * (2 * inverse))
            own_logit = inverse * (2 * (q * o).sum(1) - o.square().sum(1))
            logits = logits.scatter(1, column, own_logit[:, None])
            losses.append(self.of_logits(logits, target))
        return torch.stack(losses).mean()

    def of_logits(self, logits: Tensor, target: Tensor) -> Tensor:
        """Scalar loss of logits (q, m), higher for nearer prototypes, and targets (q,) int64."""
        return functional.cross_entropy(logits, target)
