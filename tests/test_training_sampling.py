from __future__ import annotations

import numpy as np
import pytest

from protomark.training.sampling import BatchSampler, Views
from training_scene import scene


@pytest.fixture(scope="module")
def views():
    return [Views.from_tracks(scene(landmarks=n, seed=n), str(n)) for n in (300, 900)]


def test_views_hold_every_observation_of_every_landmark():
    tracks = scene(landmarks=200, seed=5)
    found = Views.from_tracks(tracks, "x")
    ids = np.unique(tracks.landmark_of_keypoint)
    assert len(found) == len(ids)
    for i in (0, 17, len(ids) - 1):
        mine = found.descriptors[found.starts[i] : found.starts[i + 1]]
        theirs = tracks.descriptors[tracks.landmark_of_keypoint == ids[i]]
        np.testing.assert_array_equal(mine, theirs)


def test_batches_hold_distinct_views_of_one_sequence(views):
    sampler = BatchSampler(views, landmarks=150, views=5, queries=2)
    owners = [
        {
            bytes(row): i
            for i in range(len(v))
            for row in v.descriptors[v.starts[i] : v.starts[i + 1]]
        }
        for v in views
    ]
    for seed in range(5):
        batch = sampler.sample(np.random.default_rng(seed))
        rows = [bytes(row) for row in batch.descriptors]
        owner = next(o for o in owners if rows[0] in o)
        assert len(np.unique(batch.landmarks)) == 150
        assert len(set(rows)) == len(rows)
        counts = np.bincount(batch.landmarks)
        assert counts.max() == 5
        for j in range(150):
            assert (
                len({owner[r] for r, g in zip(rows, batch.landmarks, strict=True) if g == j}) == 1
            )
        of_query = batch.landmarks[batch.queries]
        assert (counts[of_query] >= 3).all()
        np.testing.assert_array_equal(
            np.bincount(of_query, minlength=150), np.where(counts >= 3, 2, 0)
        )


def test_the_same_generator_gives_the_same_batch(views):
    sampler = BatchSampler(views, landmarks=100)
    a, b, c = (sampler.sample(np.random.default_rng([1, s])) for s in (2, 2, 3))
    np.testing.assert_array_equal(a.descriptors, b.descriptors)
    np.testing.assert_array_equal(a.queries, b.queries)
    assert a.descriptors.shape != c.descriptors.shape or (a.descriptors != c.descriptors).any()


@pytest.mark.parametrize(("balance", "share"), [(0.0, 0.5), (1.0, 0.25), (0.5, 0.366)])
def test_balance_between_sequences(views, balance, share):
    sampler = BatchSampler(views, balance=balance)
    assert sampler.probability[0] == pytest.approx(share, abs=0.01)


def test_noise_flips_its_share_of_bits(views):
    clean = BatchSampler(views, landmarks=200).sample(np.random.default_rng(0))
    noisy = BatchSampler(views, landmarks=200, noise=0.05).sample(np.random.default_rng(0))
    flipped = np.unpackbits(clean.descriptors ^ noisy.descriptors).mean()
    assert flipped == pytest.approx(0.05, abs=0.003)
