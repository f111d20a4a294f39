"""An encoder's network in floating point, for peers to compute."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import protomark as pm

_ALPHA, _SCALE = 1.6732632423543772, 1.0507009873554805  # of SELU


@dataclass(frozen=True)
class FloatLayer:
    """A layer y = weights @ x + bias, followed by SELU unless it is the last.

    Attributes:
        weights: (out, in) float32.
        bias: (out,) float32.
        step, middle: an 8-bit pre-activation q means step * q + middle.
        unit, zero: an 8-bit activation a means unit * (a - zero); 1 and 0 after the last layer.
    """

    weights: NDArray[np.float32]
    bias: NDArray[np.float32]
    step: float
    middle: float
    unit: float
    zero: int


def float_layers(encoder: pm.Encoder, dim: int) -> list[FloatLayer]:
    """The layers of an encoder, cut to `dim`, as real numbers from bits 0 and 1 to code units."""
    result = []
    unit, zero = 1.0, 0
    for layer in encoder.layers:
        last = layer["table"] is None
        rows = slice(dim if last else None)
        whole = layer["weights"][rows].astype(np.float64)
        scale = layer["multipliers"][rows] / 2.0 ** layer["shift"]
        step, middle, next_unit, next_zero = (1.0, 0.0, 1.0, 0) if last else _fit(layer["table"])
        # sum = whole @ x + bias over the whole x; x = real / unit + zero.
        weights = whole * (scale * step / unit)[:, None]
        bias = (whole.sum(axis=1) * zero + layer["bias"][rows]) * scale * step + middle
        result.append(
            FloatLayer(
                weights.astype(np.float32),
                bias.astype(np.float32),
                step,
                middle,
                next_unit,
                next_zero,
            )
        )
        unit, zero = next_unit, next_zero
    return result


def bits_of(descriptors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Bits (n, 8 B) of descriptors (n, B), least significant bit first."""
    return np.unpackbits(descriptors, axis=1, bitorder="little")


def selu(x: NDArray[np.floating]) -> NDArray[np.floating]:
    """The activation of the networks that ship."""
    return _SCALE * np.where(x > 0, x, _ALPHA * np.expm1(np.minimum(x, 0)))


def _fit(table: NDArray[np.uint8]) -> tuple[float, float, float, int]:
    """Step, middle, unit and zero of the 8-bit SELU in a table.

    The table is selu(step * q + middle) for q from -128 to 127, scaled to 0 to 255. A search that
    becomes finer with each pass finds both ends of its range.
    """
    q = np.arange(-128, 128)
    low, high, reach = -2.5, 10.0, np.array([2.5, 9.5])
    best = np.inf
    for _ in range(12):
        lows = low + np.linspace(-1, 1, 9) * reach[0]
        highs = high + np.linspace(-1, 1, 9) * reach[1]
        for a in lows:
            for b in highs[highs > a + 1e-3]:
                step = (b - a) / 255
                real = selu(step * q + a + 128 * step)
                unit = (real[-1] - real[0]) / 255
                error = float(np.abs((real - real[0]) / unit - table).sum()) if unit > 0 else np.inf
                if error < best:
                    best, low, high = error, a, b
        reach = reach * 0.5
    step = (high - low) / 255
    middle = low + 128 * step
    real = selu(step * q + middle)
    unit = (real[-1] - real[0]) / 255
    return float(step), float(middle), float(unit), round(-real[0] / unit)
