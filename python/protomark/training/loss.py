"""The prototype loss: a view is classified among the prototypes of a batch.

This trains the operation that the map performs. The classification is a softmax over negative
squared distances (Eq. 3 of the paper). The prototype of the query's landmark is the mean (Eq. 1) of
its *other* views, as a map does not contain the query.
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
    """The queries of a batch, and the prototypes that they are compared with.

    Args:
        embeddings: (n, k) float, one row per view.
        landmarks: (n,) int64, landmark of each row, each of 0..m-1 with a view.
        queries: (q,) int64, rows to classify; their landmarks have at least 2 views.

    Returns:
        Queries (q, k) float32; their landmarks (q,) int64; means (q, k) of the other views of these
        landmarks; means (m, k) of all views of each landmark.
    """
    embeddings = embeddings.float()
    count = torch.bincount(landmarks)
    total = embeddings.new_zeros(len(count), embeddings.shape[1])
    total = total.index_add(0, landmarks, embeddings)
    query, target = embeddings[queries], landmarks[queries]
    others = (total[target] - query) / (count[target] - 1)[:, None]
    return query, target, others, total / count[:, None]


class PrototypeLoss(nn.Module):
    """Cross-entropy over the prototypes of a batch, averaged over nested prefixes.

    For every d in `dims` the first d numbers of an embedding are trained to work alone (Kusupati et
    al., Matryoshka Representation Learning, NeurIPS 2022), with a learned temperature, as distances
    grow with d.
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
        """Scalar loss of one batch: the mean over queries and prefixes.

        The batch is that of `leave_one_out`; `dims` are the prefixes that count, None: all.
        """
        query, target, others, prototype = leave_one_out(embeddings, landmarks, queries)

        losses = []
        column = target[:, None]
        for d, log_temperature in zip(self.dims, self.log_temperature, strict=True):
            if dims is not None and d not in dims:
                continue
            # |q - p|^2 without |q|^2, which is the same for all prototypes.
            q, p, o = query[:, :d], prototype[:, :d], others[:, :d]
            inverse = torch.exp(-log_temperature)
            logits = torch.addmm(-inverse * p.square().sum(1), q, p.T * (2 * inverse))
            target_logit = inverse * (2 * (q * o).sum(1) - o.square().sum(1))
            logits = logits.scatter(1, column, target_logit[:, None])
            losses.append(self.of_logits(logits, target))
        return torch.stack(losses).mean()

    def of_logits(self, logits: Tensor, target: Tensor) -> Tensor:
        """Scalar loss of logits (q, m), higher for nearer prototypes, and targets (q,) int64."""
        return functional.cross_entropy(logits, target)
