"""Quantises the float network to the integer encoder.

`QuantizedNetwork` computes in floating point what the integer encoder computes, including
rounding, and passes gradients straight through the rounding; training ends with it in the loop.
`export` returns the same network as integer layers.

Weights are int8 with one scale per output. A pre-activation is rounded to 8 bits over a range
[low, high] of its layer, looked up in a 256-entry table that holds SELU, and comes out as uint8.
The embedding is rounded to int8 codes at one scale for all dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypedDict

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from protomark.training.network import EncoderNetwork

_QUANTILE = 0.9999  # share of the pre-activations of calibration descriptors that ranges cover
_FLAT = -5.0  # SELU is flat below, so that a wider range would waste steps
_MAX_MULT = 1 << 30


class Layer(TypedDict):
    """One integer layer, as `protomark.Encoder` takes it.

    weights (out, in) int8, bias (out,) int32, multipliers (out,) int32 > 0, shift 1..62, and table
    (256,) uint8, None for the last layer.
    """

    weights: NDArray[np.int8]
    bias: NDArray[np.int32]
    multipliers: NDArray[np.int32]
    shift: int
    table: NDArray[np.uint8] | None


def _round(x: Tensor) -> Tensor:
    """Round halves up, as the integer encoder's shift does."""
    return torch.floor(x + 0.5)


def _straight_through(x: Tensor, value: Tensor) -> Tensor:
    """`value` with the gradient of `x`."""
    return x + (value - x).detach()


@dataclass(frozen=True)
class _Activation:
    """SELU between 8-bit pre-activations and 8-bit activations.

    A pre-activation p becomes q = round((p - middle) / step), the activation is table[q + 128], and
    its real value is (table[q + 128] - zero) * unit.
    """

    middle: float
    step: float
    unit: float
    zero: int
    table: Tensor

    @classmethod
    def between(cls, low: Tensor, high: Tensor) -> _Activation:
        step = (float(high) - float(low)) / 255
        middle = float(low) + 128 * step
        real = torch.selu(torch.arange(-128, 128, dtype=torch.float64) * step + middle)
        unit = float(real[-1] - real[0]) / 255
        zero = round(-float(real[0]) / unit)
        table = (torch.round(real / unit) + zero).clamp(0, 255)
        return cls(middle, step, unit, zero, table.to(low.device, torch.float32))


class QuantizedNetwork(nn.Module):
    """An `EncoderNetwork` as its integer encoder computes it.

    It shares the parameters of the float network; `calibrate` sets its ranges, which are buffers.

    Attributes:
        low: (hidden layers,) smallest pre-activation that 8 bits cover, by layer.
        high: (hidden layers,) largest pre-activation that 8 bits cover, by layer.
        scale: real value of one code unit.
    """

    low: Tensor
    high: Tensor
    scale: Tensor

    def __init__(self, network: EncoderNetwork) -> None:
        super().__init__()
        self.network = network
        self.scaling = network.scaling
        hidden = len(network.layers) - 1
        device = next(network.parameters()).device
        self.register_buffer("low", torch.full((hidden,), -4.0, device=device))
        self.register_buffer("high", torch.full((hidden,), 4.0, device=device))
        self.register_buffer("scale", torch.tensor(1 / 16, device=device))

    @torch.no_grad()
    def calibrate(self, inputs: Tensor) -> None:
        """Set ranges and code scale by the float network's activations for `inputs` (n, d)."""
        x = inputs
        *hidden, last = self.network.layers
        for i, layer in enumerate(hidden):
            pre = layer(x)
            self.low[i] = max(_quantile(pre, 1 - _QUANTILE), _FLAT)
            self.high[i] = max(_quantile(pre, _QUANTILE), float(self.low[i]) + 1e-3)
            x = torch.selu(pre)
        self.scale.fill_(max(_quantile(last(x).abs(), _QUANTILE), 1e-6) / 127)

    def _activation(self, layer: int) -> _Activation | None:
        if layer == len(self.low):
            return None
        return _Activation.between(self.low[layer], self.high[layer])

    def forward(self, inputs: Tensor) -> Tensor:
        """Embeddings (n, dim) float32: integer codes times `scale`."""
        # x is the layer's integer input minus its zero point. It and the weights have at most 8
        # bits and a sign, which bfloat16 represents exactly, so this may run under autocast.
        unit, zero = self.scaling.unit, self.scaling.zero
        x = inputs / unit
        for i, layer in enumerate(self.network.layers):
            weights, bias, real = _whole_numbers(layer, unit, zero, self._activation(i))
            sums = functional.linear(x, weights).float() + (bias + zero * weights.sum(1))
            activation = self._activation(i)
            if activation is None:
                pre = sums * real
                codes = _round(pre / self.scale).clamp(-127, 127)
                return _straight_through(pre, codes * self.scale)
            pre = sums * real + activation.middle
            q = _round(sums.detach() * (real / activation.step)).clamp(-128, 127)
            smooth = torch.selu(pre.clamp(float(self.low[i]), float(self.high[i])))
            whole = activation.table[(q + 128).long()] - activation.zero
            x = _straight_through(smooth / activation.unit, whole)
            unit, zero = activation.unit, float(activation.zero)
        raise AssertionError("a network has a last layer")

    @torch.no_grad()
    def export(self) -> list[Layer]:
        """The integer layers of this network."""
        layers: list[Layer] = []
        unit, zero = self.scaling.unit, self.scaling.zero
        for i, layer in enumerate(self.network.layers):
            activation = self._activation(i)
            weights, bias, real = _whole_numbers(layer, unit, zero, activation)
            step = activation.step if activation else float(self.scale)
            ratio = real.double().cpu().numpy() / step
            shift = int(np.clip(np.floor(np.log2(_MAX_MULT / ratio.max())), 1, 62))
            multipliers = np.clip(np.rint(ratio * 2.0**shift), 1, _MAX_MULT)
            layers.append(
                Layer(
                    weights=weights.cpu().numpy().astype(np.int8),
                    bias=bias.cpu().numpy().astype(np.int32),
                    multipliers=multipliers.astype(np.int32),
                    shift=shift,
                    table=activation.table.cpu().numpy().astype(np.uint8) if activation else None,
                )
            )
            if activation:
                unit, zero = activation.unit, float(activation.zero)
        return layers


def _whole_numbers(
    layer: nn.Module, unit: float, zero: float, activation: _Activation | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Weights (out, in) and bias (out,) as whole numbers, and the real value of their unit (out,).

    Inputs are (x - zero) * unit for whole x, and `activation.middle` is subtracted from outputs: up
    to rounding, (weights @ x + bias) * real = layer((x - zero) * unit) - middle.
    """
    assert isinstance(layer, nn.Linear)
    scale = layer.weight.detach().abs().amax(1).clamp_min(1e-8) / 127
    weights = layer.weight / scale[:, None]
    weights = _straight_through(weights, weights.detach().round())
    real = scale * unit
    middle = activation.middle if activation else 0.0
    bias = (layer.bias - middle) / real - zero * weights.sum(1).detach()
    return weights, _straight_through(bias, bias.detach().round()), real


def _quantile(x: Tensor, q: float) -> float:
    flat = x.flatten()
    k = min(max(round(q * flat.numel()), 1), flat.numel())
    return float(flat.kthvalue(k).values)
