from __future__ import annotations

import numpy as np
import pytest
import torch

import protomark as pm
from conftest import descriptors_for, reference_encode
from protomark import models
from protomark.training.network import (
    BITS,
    MAX_WEIGHT_BYTES,
    EncoderNetwork,
    default_hidden,
    embed,
    weight_bytes,
)
from protomark.training.quantization import Layer, QuantizedNetwork


def random_descriptors(n: int, bits: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (n, bits // 8), dtype=np.uint8)


def quantized(bits: int, dim: int, hidden=None, seed: int = 0) -> QuantizedNetwork:
    torch.manual_seed(seed)
    network = EncoderNetwork(bits, dim, hidden)
    for layer in network.layers:
        torch.nn.init.normal_(layer.bias, std=0.3)
    found = QuantizedNetwork(network)
    found.calibrate(BITS.inputs(random_descriptors(1000, bits, seed=9)))
    return found


CASES = [(64, 8, (32, 16)), (256, 32, None), (512, 32, None), (512, 64, ()), (1024, 32, None)]


@pytest.mark.parametrize(("bits", "dim", "hidden"), CASES)
def test_simulation_equals_integer_arithmetic(bits, dim, hidden):
    model = quantized(bits, dim, hidden)
    descriptors = random_descriptors(2000, bits)
    codes = reference_encode(model.export(), descriptors)
    assert codes.dtype == np.int8
    assert codes.shape == (2000, dim)
    simulated = np.rint(embed(model, descriptors) / float(model.scale))
    # Float32 rounds a pre-activation that lies within 1e-5 of a half now and then to the other
    # side, which may move a code by one.
    assert np.abs(simulated - codes).max() <= 1
    assert (simulated == codes).mean() > 0.999


@pytest.mark.parametrize(("bits", "dim", "hidden"), CASES)
def test_integer_codes_are_close_to_the_float_network(bits, dim, hidden):
    model = quantized(bits, dim, hidden)
    descriptors = random_descriptors(2000, bits)
    real = embed(model.network, descriptors)
    codes = reference_encode(model.export(), descriptors) * float(model.scale)
    error = np.sqrt(((real - codes) ** 2).mean() / (real**2).mean())
    assert error < 0.03


@pytest.mark.parametrize(("bits", "dim", "hidden"), CASES)
def test_the_core_encodes_the_same_bytes(bits, dim, hidden, tmp_path):
    model = quantized(bits, dim, hidden)
    layers = model.export()
    encoder = pm.Encoder(
        layers,
        dims=[dim // 2, dim],
        name="x",
        descriptor="x",
        scale=float(model.scale),
        data="",
        licence="",
    )
    encoder.save(tmp_path / "x.pme")
    descriptors = random_descriptors(2000, bits)
    expected = reference_encode(layers, descriptors)
    loaded = pm.Encoder.load(tmp_path / "x.pme")
    np.testing.assert_array_equal(encoder.encode(descriptors), expected)
    np.testing.assert_array_equal(loaded.encode(descriptors), expected)
    np.testing.assert_array_equal(loaded.encode(descriptors, dim=dim // 2), expected[:, : dim // 2])


@pytest.mark.parametrize("name", models.names())
def test_encoders_that_ship_encode_as_their_layers_say(name):
    encoder = pm.Encoder.load(name)
    descriptors = descriptors_for(encoder, 3000)
    np.testing.assert_array_equal(
        encoder.encode(descriptors),
        reference_encode(encoder.layers, descriptors, encoder.input, encoder.input_scale),
    )


def test_integer_arithmetic_by_hand():
    # Two inputs' worth of bits, one hidden unit whose table doubles, one output.
    table = np.clip(2 * (np.arange(256) - 128), 0, 255).astype(np.uint8)
    hidden = np.zeros((1, 8), np.int8)
    hidden[0, [0, 7]] = 10, 100
    layers = [
        Layer(weights=hidden, bias=np.int32([-6]), multipliers=np.int32([3]), shift=2, table=table),
        Layer(
            weights=np.int8([[-1]]),
            bias=np.int32([5]),
            multipliers=np.int32([1]),
            shift=1,
            table=None,
        ),
    ]
    # bit 0: (10-6)*3=12 -> (12+2)>>2=3 -> 6 -> 5-6=-1 -> (-1+1)>>1=0
    # bit 7: 94*3=282 -> 284>>2=71 -> 142 -> -137 -> -136>>1=-68
    # none: -18 -> -16>>2=-4 -> 0 -> 5 -> 6>>1=3; both: 312 -> 78 -> 156 -> -151 -> -75
    descriptors = np.uint8([[1], [128], [0], [129]])
    np.testing.assert_array_equal(reference_encode(layers, descriptors), [[0], [-68], [3], [-75]])


def test_gradients_reach_every_weight():
    model = quantized(64, 8, (32, 16))
    model(BITS.inputs(random_descriptors(500, 64))).square().sum().backward()
    for layer in model.network.layers:
        assert (layer.weight.grad.abs().sum(1) > 0).all()
        assert (layer.bias.grad != 0).all()


def test_a_dead_unit_does_not_break_the_export():
    model = quantized(64, 8, (32, 16))
    with torch.no_grad():
        model.network.layers[0].weight[3] = 0
    for layer in model.export():
        assert (layer["multipliers"] > 0).all()
        assert 1 <= layer["shift"] <= 62
    reference_encode(model.export(), random_descriptors(10, 64))


@pytest.mark.parametrize("bits", [64, 256, 488, 512, 1024])
def test_default_networks_stay_within_the_size_that_ships(bits):
    assert weight_bytes(bits, default_hidden(bits, 64), 64) <= MAX_WEIGHT_BYTES
