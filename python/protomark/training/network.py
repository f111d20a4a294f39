"""The encoder as a floating-point network: fully connected layers with SELU in between.

Inputs are centred and scaled for the self-normalising activation: bits are -1 and +1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from protomark.features.descriptors import InputKind, numbers_of

if TYPE_CHECKING:
    from protomark.training.quantization import QuantizedNetwork

# Limit on the int8 weights of an encoder that ships.
MAX_WEIGHT_BYTES = 600_000
_WIDEST = 768
# Share of the numbers of float vectors that their 8 bits cover.
_COVERED = 0.9999


@dataclass(frozen=True)
class InputScaling:
    """What descriptors are to a network: whole numbers x, of which it sees (x - zero) * unit."""

    kind: InputKind = "bits"
    zero: float = 0.5
    unit: float = 2.0  # a power of two, so that nothing is rounded
    # Numbers of float32 vectors are multiplied by this, rounded to -127..127, and have 128 added.
    scale: float = 0.0

    @classmethod
    def fit(cls, kind: InputKind, descriptors: NDArray[Any]) -> InputScaling:
        """The scaling that centres descriptors (n, d) like these; bits need no fit."""
        if kind == "bits":
            return cls()
        scale = 0.0
        if kind == "float32":
            scale = float(np.float32(127 / np.quantile(np.abs(descriptors), _COVERED)))
        x = cls(kind, 0, 1, scale).whole(descriptors)
        unit = 2.0 ** -np.rint(np.log2(max(float(x.std(dtype=np.float64)), 1.0)))
        return cls(kind, float(np.rint(x.mean(dtype=np.float64))), float(unit), scale)

    def whole(self, descriptors: NDArray[Any]) -> NDArray[np.uint8]:
        """The numbers x (n, d) uint8 that the first layer of an encoder multiplies."""
        numbers = numbers_of(np.ascontiguousarray(descriptors), self.kind)
        if self.kind != "float32":
            return numbers
        scaled = np.rint(numbers * np.float32(self.scale)).clip(-127, 127) + 128
        return scaled.astype(np.uint8)

    def inputs(self, descriptors: NDArray[Any], device: torch.device | str = "cpu") -> Tensor:
        """What the network sees (n, d) float32 of descriptors, on `device`."""
        whole = torch.from_numpy(self.whole(descriptors)).to(device)
        return whole.to(torch.float32).sub_(self.zero).mul_(self.unit)


BITS = InputScaling()


def weight_bytes(inputs: int, hidden: Sequence[int], dim: int) -> int:
    """Bytes of the int8 weights of a network inputs -> hidden... -> dim."""
    widths = [inputs, *hidden, dim]
    return sum(a * b for a, b in pairwise(widths))


def default_hidden(inputs: int, dim: int) -> tuple[int, ...]:
    """One hidden layer of up to 768 units whose int8 weights fit into `MAX_WEIGHT_BYTES`.

    The paper's funnel (two hidden layers, the second half as wide) fits the training sequences
    better, but others worse.
    """
    width = _WIDEST
    while weight_bytes(inputs, (width,), dim) > MAX_WEIGHT_BYTES:
        width -= 32
    return (width,)


class EncoderNetwork(nn.Module):
    """Maps inputs (n, d) float32, as `scaling` makes them, to embeddings (n, dim) float32.

    `hidden` are the widths of the hidden layers; None: `default_hidden`.
    """

    def __init__(
        self,
        inputs: int,
        dim: int,
        hidden: Sequence[int] | None = None,
        scaling: InputScaling = BITS,
    ) -> None:
        super().__init__()
        self.scaling = scaling
        self.hidden = tuple(hidden) if hidden is not None else default_hidden(inputs, dim)
        self.widths = [inputs, *self.hidden, dim]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(self.widths))
        for layer in self.layers:
            assert isinstance(layer, nn.Linear)
            # With LeCun's normal weights SELU keeps activations at mean 0 and variance 1.
            nn.init.normal_(layer.weight, std=layer.in_features**-0.5)
            nn.init.zeros_(layer.bias)

    def forward(self, inputs: Tensor) -> Tensor:
        """Embeddings (n, dim) of inputs (n, d)."""
        x = inputs
        for layer in self.layers[:-1]:
            x = torch.selu(layer(x))
        out: Tensor = self.layers[-1](x)
        return out


@torch.no_grad()
def embed(
    network: EncoderNetwork | QuantizedNetwork,
    descriptors: NDArray[Any],
    device: torch.device | str = "cpu",
    batch: int = 4096,
) -> NDArray[np.float32]:
    """Embeddings (n, dim) float32 of descriptors (n, b), in full precision."""
    parts = [
        network(network.scaling.inputs(descriptors[i : i + batch], device)).float().cpu().numpy()
        for i in range(0, len(descriptors), batch)
    ]
    return np.concatenate(parts)
