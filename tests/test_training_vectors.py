"""Training and evaluation on vectors: SIFT's bytes, and floats."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import protomark as pm
from conftest import protomark, reference_encode
from evaluation_scene import ring_scene
from protomark.baselines.binary import majority, medoid, unaggregated
from protomark.baselines.clusters import mean_shift
from protomark.baselines.support import Moments, Support
from protomark.evaluation.methods import choose_methods, method_choices
from protomark.features.descriptors import DESCRIPTORS
from protomark.tracks.file import Tracks
from protomark.training.network import EncoderNetwork, InputScaling, embed
from protomark.training.quantization import QuantizedNetwork
from protomark.training.sampling import with_noise
from small_tracks import small_tracks
from training_scene import scene

KINDS = ("uint8", "float32")


def vectors(n: int, kind: str, seed: int = 0, width: int = 128) -> np.ndarray:
    """Like SIFT's: RootSIFT's bytes, or unit vectors."""
    rng = np.random.default_rng(seed)
    x = rng.gamma(0.6, size=(n, width))
    if kind == "uint8":
        return np.rint(512 * np.sqrt(x / x.sum(1, keepdims=True))).clip(0, 255).astype(np.uint8)
    x = x * rng.choice([-1, 1], x.shape)
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


def as_vectors(tracks: Tracks, kind: str) -> Tracks:
    """The tracks with the bits of their descriptors as noisy numbers of vectors."""
    bits = np.unpackbits(tracks.descriptors, axis=1, bitorder="little").astype(np.float32)
    x = 20 + 80 * bits + np.random.default_rng(0).normal(0, 10, bits.shape).astype(np.float32)
    descriptors = np.rint(x).clip(0, 255).astype(np.uint8) if kind == "uint8" else x / 1000
    return replace(tracks, descriptors=descriptors, input=kind)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("hidden", [(96,), (), (64, 32)])
def test_integer_encoders_are_what_training_computes(kind, hidden, tmp_path):
    torch.manual_seed(0)
    descriptors, seen = vectors(2000, kind), vectors(1000, kind, seed=9)
    scaling = InputScaling.fit(kind, seen)
    network = EncoderNetwork(128, 32, hidden, scaling)
    inputs = scaling.inputs(descriptors)
    assert abs(float(inputs.mean())) < 0.1
    assert 0.6 < float(inputs.std()) < 1.6
    model = QuantizedNetwork(network)
    model.calibrate(scaling.inputs(seen))
    layers = model.export()
    codes = reference_encode(layers, descriptors, kind, scaling.scale)
    simulated = np.rint(embed(model, descriptors) / float(model.scale))
    # Float32 rounds what lies within 1e-5 of a half now and then to the other side.
    assert np.abs(simulated - codes).max() <= 1
    assert (simulated == codes).mean() > 0.999
    real = embed(network, descriptors)
    error = codes * float(model.scale) - real
    assert np.sqrt((error**2).mean() / (real**2).mean()) < 0.03

    described = {"dims": [16, 32], "name": "v", "descriptor": "v", "scale": 1.0}
    encoder = pm.Encoder(layers, **described, input=kind, input_scale=scaling.scale)
    encoder.save(tmp_path / "v.pme")
    for same in (encoder, pm.Encoder.load(tmp_path / "v.pme")):
        np.testing.assert_array_equal(same.encode(descriptors), codes)


def test_gradients_reach_the_first_layer():
    scaling = InputScaling.fit("uint8", vectors(500, "uint8"))
    model = QuantizedNetwork(EncoderNetwork(128, 8, (16,), scaling))
    model.calibrate(scaling.inputs(vectors(500, "uint8")))
    model(scaling.inputs(vectors(500, "uint8", seed=1))).square().sum().backward()
    assert (model.network.layers[0].weight.grad.abs().sum(1) > 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_noise_is_a_share_of_the_vectors_own_square(kind):
    x = vectors(500, kind)
    noisy = with_noise(x, kind, 0.02, np.random.default_rng(0))
    assert noisy.dtype == x.dtype
    difference = noisy.astype(float) - x
    # Bytes have no numbers below 0, where half of the noise on small ones would be.
    least = 0.01 if kind == "uint8" else 0.019
    assert least < np.square(difference).mean() / np.square(x.astype(float)).mean() < 0.021


@pytest.mark.parametrize("kind", KINDS)
def test_tracks_of_vectors_come_back_from_their_file(kind, tmp_path):
    tracks = replace(small_tracks(), descriptor="vector", descriptors=vectors(40, kind), input=kind)
    tracks.save(tmp_path / "t.safetensors")
    read = Tracks.load(tmp_path / "t.safetensors")
    assert (read.input, read.width) == (kind, 128)
    assert read.bits == 8 * tracks.descriptors[0].nbytes
    assert read.descriptors.dtype == tracks.descriptors.dtype
    np.testing.assert_array_equal(read.descriptors, tracks.descriptors)
    assert read.where(read.landmark_of_keypoint >= 0).input == kind
    with pytest.raises(ValueError, match="no upright form"):
        read.upright()


@pytest.mark.parametrize(
    ("kind", "change", "words"),
    [
        ("uint8", lambda x: x[:, :15], "15 numbers, not 16 to 1024"),
        ("uint8", lambda x: np.repeat(x, 9, axis=1), "1152 numbers, not 16 to 1024"),
        ("uint8", lambda x: x * (np.arange(40) != 7)[:, None].astype(np.uint8), "[7] is a vector"),
        ("float32", lambda x: x + np.float32(np.nan), "descriptors contains NaN"),
        ("float32", lambda x: x * np.float32(np.inf), "descriptors contains NaN"),
        ("float32", lambda x: x.astype(np.float64), "expected float32"),
        ("float64", lambda x: x, "input 'float64' is none of bits"),
    ],
)
def test_tracks_refuse_broken_vectors(kind, change, words):
    x = change(vectors(40, "uint8" if kind == "uint8" else "float32"))
    with np.errstate(invalid="ignore"), pytest.raises(ValueError, match=r".") as caught:
        replace(small_tracks(), descriptor="vector", descriptors=x, input=kind).check()
    assert words in str(caught.value)


def test_sift_is_the_vector_that_tracks_know():
    assert (DESCRIPTORS["sift"].bytes, DESCRIPTORS["sift"].input) == (128, "uint8")


@given(st.integers(0, 2**32 - 1), st.integers(1, 3))
def test_methods_of_vectors_by_their_definition(seed, spread):
    rng = np.random.default_rng(seed)
    landmarks = np.sort(rng.integers(0, 9, 40)) * 7
    # Few distinct numbers, so that ties are common.
    x = (spread * rng.integers(1, 4, (40, 16))).astype(np.uint8)
    queries = (spread * rng.integers(1, 4, (5, 16))).astype(np.uint8)
    support, ids = Support(landmarks, x, kind="uint8"), np.unique(landmarks)
    squared = np.square(queries[:, None].astype(int) - x[None].astype(int)).sum(2)
    nearest = np.stack([squared[:, landmarks == i].min(1) for i in ids], axis=1)
    order = np.argsort(nearest, axis=1, kind="stable")[:, :2]
    found, distances = unaggregated(support).match(queries)
    np.testing.assert_array_equal(found, ids[order])
    np.testing.assert_array_equal(np.rint(distances**2), np.take_along_axis(nearest, order, axis=1))
    for i in ids:
        own = x[landmarks == i].astype(int)
        each = np.sort(np.square(own[:, None] - own[None]).sum(2), axis=1)
        best = np.argmin(each[:, (len(own) - 1) // 2])
        of_kind = Support(np.zeros(len(own), np.int64), own.astype(np.uint8), kind="uint8")
        # The query that is the medoid, or the rounded mean, is at no distance from it.
        kept = {medoid: own[best], majority: np.rint(own.mean(0, dtype=np.float32))}
        for method, expected in kept.items():
            _, distance = method(of_kind).match(expected[None].astype(np.uint8))
            assert distance[0, 0] == 0


def test_moments_of_vectors_are_their_covariances():
    x = vectors(500, "uint8")
    moments = Moments.of(Support(np.repeat(np.arange(100), 5), x, kind="uint8"))
    np.testing.assert_allclose(moments.mean, x.mean(0))
    np.testing.assert_allclose(moments.total, np.cov(x.T, bias=True), atol=1e-8)


def test_mean_shift_finds_the_sides_of_a_landmark():
    rng = np.random.default_rng(0)
    sides = vectors(30, "uint8").astype(float).reshape(10, 3, 128)
    owner = np.repeat(np.arange(10), 12)
    x = (sides[owner, np.tile(np.arange(12) % 3, 10)] + rng.normal(0, 2, (120, 128))).clip(0, 255)
    support = Support(owner, x.astype(np.uint8), kind="uint8")
    built = mean_shift(support)
    assert built.bytes_per_landmark == 3 * 128 + 1
    ids, distances = built.match(sides.reshape(30, 128).astype(np.uint8))
    np.testing.assert_array_equal(ids[:, 0], np.repeat(np.arange(10), 3))
    assert distances[:, 0].max() < 20
    assert mean_shift(support, bandwidth=10).bytes_per_landmark == 129


def test_methods_for_vectors_and_for_bits():
    of_bits = {c.name for c in method_choices()}
    of_vectors = {c.name for c in method_choices(width=128, kind="uint8")}
    # There are as many components as numbers.
    components = {"itq-32", "itq-64", "rabitq1-32", "rabitq1-64", "rabitq2-64", "rabitq3-64"}
    assert of_bits - of_vectors == {"and"} | components
    assert of_vectors - of_bits == {"clusters"}
    with pytest.raises(ValueError, match="no method 'and' for these descriptors"):
        choose_methods(method_choices(width=128, kind="uint8"), ["and"])


@pytest.mark.parametrize("kind", KINDS)
def test_train_and_evaluate_on_vectors(kind, tmp_path):
    for name, seed in (("a", 1), ("b", 2)):
        as_vectors(scene(seed=seed), kind).save(tmp_path / f"{name}.safetensors")
    out = tmp_path / "v.pme"
    done = protomark(
        "train", tmp_path / "a.safetensors", tmp_path / "b.safetensors", "-o", out, "--dims",
        "8,16", "--steps", 60, "--batch", 200, "--threads", 1, "--json", tmp_path / "v.json",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    encoder = pm.Encoder.load(out)
    assert (encoder.input, encoder.inputs) == (kind, 128)
    (figures,) = json.loads((tmp_path / "v.json").read_text())["figures"]
    assert figures["integer_precision"]["16"] == pytest.approx(
        figures["float_precision"]["16"], abs=0.03
    )
    assert figures["integer_precision"]["16"] > 0.3
    assert f"descriptors of 128 numbers ({kind})" in (tmp_path / "v.md").read_text()

    as_vectors(ring_scene(bits=128), kind).save(tmp_path / "ring.safetensors")
    done = protomark(
        "evaluate", tmp_path / "ring.safetensors", "--seeds", 1, "--pose-frames", 2,
        "--encoder", out, "--json", tmp_path / "e.json",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (result,) = json.loads((tmp_path / "e.json").read_text())["sequences"]
    found = {m["name"]: m["precision"][0] for m in result["methods"]}
    assert {"unaggregated", "medoid", "majority", "clusters", "pca-16", "pq-32"} <= set(found)
    assert found["unaggregated"] > 0.95
