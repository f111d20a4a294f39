"""Second-order similarity as a further term of the loss: tried, not shipped.

`training_ablation.py` measures it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from protomark.training.loss import PrototypeLoss, leave_one_out

_TINY = 1e-6  # keeps the gradient of a root finite at 0


class SecondOrderLoss(PrototypeLoss):
    """`PrototypeLoss` and `weight` times a second-order similarity term.

    After Tian et al., *SOSNet: Second Order Similarity Regularization for Local Descriptor
    Learning*, CVPR 2019, with a view and the mean of its landmark's other views as the matching
    pair: both should have the same distances to the prototypes around them, those nearest to
    either. Distances are in units of the root of the temperature, as the classification sees them.

    Args:
        dims: see `PrototypeLoss`.
        weight: of the term.
        nearest: how many prototypes around a pair count; 8 in the paper.
    """

    def __init__(self, dims: Sequence[int], weight: float, nearest: int = 8) -> None:
        super().__init__(dims)
        self.weight = weight
        self.nearest = nearest

    def forward(
        self,
        embeddings: Tensor,
        landmarks: Tensor,
        queries: Tensor,
        dims: Sequence[int] | None = None,
    ) -> Tensor:
        """As `PrototypeLoss`."""
        first = super().forward(embeddings, landmarks, queries, dims)
        query, target, own, prototype = leave_one_out(embeddings, landmarks, queries)
        terms = [
            self._term(query[:, :d], own[:, :d], prototype[:, :d], target)
            / torch.exp(log_temperature.detach() / 2)
            for d, log_temperature in zip(self.dims, self.log_temperature, strict=True)
            if dims is None or d in dims
        ]
        return first + self.weight * torch.stack(terms).mean()

    def _term(self, query: Tensor, own: Tensor, prototype: Tensor, target: Tensor) -> Tensor:
        with torch.no_grad():
            either = torch.minimum(torch.cdist(query, prototype), torch.cdist(own, prototype))
            either.scatter_(1, target[:, None], torch.inf)
            around = either.topk(min(self.nearest, len(prototype) - 1), largest=False).indices
        beside = prototype[around]
        difference = _distance(query, beside) - _distance(own, beside)
        return (difference.square().sum(1) + _TINY).sqrt().mean()


def _distance(x: Tensor, others: Tensor) -> Tensor:
    """(q, k) distances of x (q, d) to others (q, k, d)."""
    return ((x[:, None] - others).square().sum(2) + _TINY).sqrt()
