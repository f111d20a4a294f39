"""The network in PyTorch, float32."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from protomark_bench.speed.peers.network import FloatLayer


def network(layers: list[FloatLayer]) -> torch.nn.Module:
    """The network from bits (n, bits) float32 to codes (n, dim) float32."""
    modules: list[torch.nn.Module] = []
    for i, layer in enumerate(layers):
        linear = torch.nn.Linear(layer.weights.shape[1], layer.weights.shape[0])
        with torch.no_grad():
            linear.weight.copy_(torch.from_numpy(layer.weights))
            linear.bias.copy_(torch.from_numpy(layer.bias))
        modules.append(linear)
        if i + 1 < len(layers):
            modules.append(torch.nn.SELU(inplace=True))
    return torch.nn.Sequential(*modules).eval()


def runner(
    layers: list[FloatLayer], bits: NDArray[np.uint8]
) -> Callable[[int], NDArray[np.float32]]:
    """A function that computes the codes of the first n rows of `bits`."""
    model = network(layers)
    inputs = torch.from_numpy(bits.astype(np.float32))

    def run(n: int) -> NDArray[np.float32]:
        with torch.inference_mode():
            return model(inputs[:n]).numpy()

    return run
