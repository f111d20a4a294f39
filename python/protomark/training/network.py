"""The encoder as a floating-point network: fully connected layers with SELU in between.

Inputs are bits as -1 and +1, so that they are centred for the self-normalising activation.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from protomark.features.descriptors import unpack_bits

# Limit on the int8 weights of an encoder that ships.
MAX_WEIGHT_BYTES = 600_000
_WIDEST = 768


def weight_bytes(bits: int, hidden: Sequence[int], dim: int) -> int:
    """Bytes of the int8 weights of a network bits -> hidden... -> dim."""
    widths = [bits, *hidden, dim]
    return sum(a * b for a, b in pairwise(widths))


def default_hidden(bits: int, dim: int) -> tuple[int, ...]:
    """One hidden layer of up to 768 units whose int8 weights fit into `MAX_WEIGHT_BYTES`.

    The paper's funnel (two hidden layers, the second half as wide) fits the training sequences
    better, but others worse.
    """
    width = _WIDEST
    while weight_bytes(bits, (width,), dim) > MAX_WEIGHT_BYTES:
        width -= 32
    return (width,)


class EncoderNetwork(nn.Module):
    """Maps signs (n, bits) float32 of -1 and +1 to embeddings (n, dim) float32.

    `hidden` are the widths of the hidden layers; None: `default_hidden`.
    """

    def __init__(self, bits: int, dim: int, hidden: Sequence[int] | None = None) -> None:
        super().__init__()
        self.bits = bits
        self.dim = dim
        self.hidden = tuple(hidden) if hidden is not None else default_hidden(bits, dim)
        widths = [bits, *self.hidden, dim]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        for layer in self.layers:
            assert isinstance(layer, nn.Linear)
            # With LeCun's normal weights SELU keeps activations at mean 0 and variance 1.
            nn.init.normal_(layer.weight, std=layer.in_features**-0.5)
            nn.init.zeros_(layer.bias)

    def forward(self, signs: Tensor) -> Tensor:
        """Embeddings (n, dim) of signs (n, bits)."""
        x = signs
        for layer in self.layers[:-1]:
            x = torch.selu(layer(x))
        out: Tensor = self.layers[-1](x)
        return out


def to_signs(descriptors: NDArray[np.uint8], device: torch.device | str = "cpu") -> Tensor:
    """Signs (n, 8 B) float32 of packed descriptors (n, B) uint8, on `device`."""
    bits = torch.from_numpy(unpack_bits(np.ascontiguousarray(descriptors))).to(device)
    return bits.to(torch.float32).mul_(2).sub_(1)


@torch.no_grad()
def embed(
    network: nn.Module,
    descriptors: NDArray[np.uint8],
    device: torch.device | str = "cpu",
    batch: int = 4096,
) -> NDArray[np.float32]:
    """Embeddings (n, dim) float32 of packed descriptors (n, B) uint8, in full precision."""
    parts = [
        network(to_signs(descriptors[i : i + batch], device)).float().cpu().numpy()
        for i in range(0, len(descriptors), batch)
    ]
    return np.concatenate(parts)
