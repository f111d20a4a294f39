from __future__ import annotations

import numpy as np
import pytest
import torch

from protomark.training.loss import PrototypeLoss


def plain_loss(embeddings, landmarks, queries, dims, temperatures):
    """Eq. 1 and Eq. 3, written out query by query."""
    of = [np.flatnonzero(landmarks == j) for j in range(landmarks.max() + 1)]
    total = 0.0
    for d, temperature in zip(dims, temperatures, strict=True):
        e = embeddings[:, :d]
        for q in queries:
            distances = []
            for j, rows in enumerate(of):
                rows = rows[rows != q] if j == landmarks[q] else rows
                distances.append(((e[q] - e[rows].mean(0)) ** 2).sum() / temperature)
            logits = -np.array(distances)
            total += np.log(np.exp(logits).sum()) - logits[landmarks[q]]
    return total / len(dims) / len(queries)


def batch(rng, landmarks=7, dim=6):
    counts = rng.integers(1, 6, landmarks)
    counts[0] = 4
    group = np.repeat(np.arange(landmarks), counts)
    queries = np.flatnonzero(counts[group] >= 3)[::2]
    return rng.normal(size=(len(group), dim)), group, queries


@pytest.mark.parametrize("dims", [(6,), (2, 6), (1, 2, 5)])
def test_equals_the_equations(dims):
    embeddings, landmarks, queries = batch(np.random.default_rng(3))
    loss = PrototypeLoss(dims)
    with torch.no_grad():
        loss.log_temperature.copy_(torch.linspace(-1, 1, len(dims)))
    got = loss(
        torch.tensor(embeddings, dtype=torch.float32),
        torch.from_numpy(landmarks),
        torch.from_numpy(queries),
    )
    temperatures = np.exp(np.linspace(-1, 1, len(dims))) if len(dims) > 1 else [np.exp(-1)]
    assert float(got.detach()) == pytest.approx(
        plain_loss(embeddings, landmarks, queries, dims, temperatures), rel=1e-5
    )


def test_trains_every_embedding_number_and_every_temperature():
    embeddings, landmarks, queries = batch(np.random.default_rng(4))
    loss = PrototypeLoss((2, 6))
    e = torch.tensor(embeddings, dtype=torch.float32, requires_grad=True)
    loss(e, torch.from_numpy(landmarks), torch.from_numpy(queries)).backward()
    assert (e.grad.abs().sum(0) > 0).all()
    assert (loss.log_temperature.grad != 0).all()
