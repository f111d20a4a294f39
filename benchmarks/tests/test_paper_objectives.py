from __future__ import annotations

import numpy as np
import pytest
import torch

from protomark.training.sampling import Views
from protomark_bench.paper.objectives import (
    MAX_VIEWS,
    draw_episode,
    draw_triplets,
    prototypical_loss,
    triplet_loss,
)


def views_of(counts):
    """Views whose first two bytes encode the landmark and whose third encodes the view."""
    landmark = np.repeat(np.arange(len(counts)), counts)
    view = np.concatenate([np.arange(n) for n in counts])
    descriptors = np.stack([landmark // 256, landmark % 256, view], axis=1).astype(np.uint8)
    return Views("made", descriptors, np.concatenate([[0], np.cumsum(counts)]).astype(np.int64))


def landmark_of(views, rows):
    return views.descriptors[rows, 0].astype(int) * 256 + views.descriptors[rows, 1]


def test_triplet_loss_is_equation_4():
    rng = np.random.default_rng(0)
    a, p, n = rng.normal(size=(3, 40, 6))
    expected = np.mean(
        [
            max(np.sqrt(((x - y) ** 2).sum()) - np.sqrt(((x - z) ** 2).sum()) + 0.7, 0)
            for x, y, z in zip(a, p, n, strict=True)
        ]
    )
    got = triplet_loss(*(torch.from_numpy(e) for e in (a, p, n)), margin=0.7)
    assert float(got) == pytest.approx(expected, rel=1e-6)


def test_triplet_loss_of_equal_embeddings_has_a_finite_gradient():
    e = torch.ones(3, 4, requires_grad=True)
    loss = triplet_loss(e, e.detach(), e.detach())
    loss.backward()
    assert float(loss.detach()) == pytest.approx(1.0)
    assert torch.isfinite(e.grad).all()


def test_triplets_are_two_views_of_a_landmark_and_one_of_another():
    rng = np.random.default_rng(1)
    counts = rng.integers(1, 6, 300)
    views = views_of(counts)
    anchor, positive, negative = draw_triplets(views, 1000, rng)
    assert len(anchor) == (counts >= 2).sum()
    assert (landmark_of(views, anchor) == landmark_of(views, positive)).all()
    assert (anchor != positive).all()
    assert (landmark_of(views, anchor) != landmark_of(views, negative)).all()
    # Negatives are not only neighbours: most landmarks are drawn by so many.
    assert len(np.unique(landmark_of(views, negative))) > 100


def test_triplets_need_two_landmarks():
    with pytest.raises(ValueError, match="made: there are no two landmarks"):
        draw_triplets(views_of([4]), 8, np.random.default_rng(0))
    with pytest.raises(ValueError, match="made: there are no two landmarks"):
        draw_triplets(views_of([1, 1]), 8, np.random.default_rng(0))


def test_prototypical_loss_is_equation_3():
    rng = np.random.default_rng(2)
    counts = rng.integers(2, 6, 9)
    classes = np.repeat(np.arange(9), counts)
    is_query = np.concatenate([np.arange(n) < max(n // 3, 1) for n in counts])
    e = rng.normal(size=(len(classes), 5))
    means = np.stack([e[(classes == k) & ~is_query].mean(0) for k in range(9)])
    terms = []
    for row in np.flatnonzero(is_query):
        exps = np.exp(-((e[row] - means) ** 2).sum(1))
        terms.append(-np.log(exps[classes[row]] / exps.sum()))
    got = prototypical_loss(
        torch.from_numpy(e), torch.from_numpy(classes), torch.from_numpy(is_query)
    )
    assert float(got) == pytest.approx(np.mean(terms), rel=1e-9)


def test_episodes_have_support_and_queries_of_every_class():
    rng = np.random.default_rng(3)
    counts = rng.integers(1, 12, 400)
    views = views_of(counts)
    episode = draw_episode(views, 50, rng)
    assert (np.diff(episode.classes) >= 0).all()
    assert len(np.unique(episode.classes)) == 50
    for k in range(50):
        rows = episode.rows[episode.classes == k]
        (landmark,) = np.unique(landmark_of(views, rows))
        assert len(rows) == len(np.unique(rows)) == min(counts[landmark], MAX_VIEWS)
        queries = episode.is_query[episode.classes == k].sum()
        assert queries == max(len(rows) // 3, 1)
        assert queries < len(rows)


def test_episodes_need_two_classes():
    with pytest.raises(ValueError, match="made: an episode needs two landmarks"):
        draw_episode(views_of([5, 1]), 8, np.random.default_rng(0))
