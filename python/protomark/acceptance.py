"""How likely the nearest landmark of a keypoint is its own, by how far the two nearest are.

Of a real frame many keypoints have no landmark in the map, and their nearest one is wrong however
good the descriptor is. A fixed ratio test (Lowe, IJCV 2004) means another share of right matches
for each encoder and each length of a code. So the probability is fitted to data
(`protomark.calibration`) for each encoder and length, and is kept in the model's `info` under the
key `acceptance` (docs/format.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

import protomark as pm
from protomark.logistic import sigmoid

KEY = "acceptance"
SOURCE_KEY = "acceptance_data"
# The squared distance that stands where there is no landmark.
NO_DISTANCE = np.iinfo(np.int32).max
_WEIGHTS = 3


@dataclass(frozen=True)
class Acceptance:
    """P(right) = 1 / (1 + exp(-(w0 + w1 d^2 + w2 (s^2 - d^2)))).

    d and s are the distances to the nearest and to the second nearest landmark, in code units.
    Training makes exp(-distance^2 / T) the likelihood of a landmark (Snell et al., Prototypical
    Networks, NeurIPS 2017), so the margin between two of them is a difference of squares; d itself
    says whether the keypoint's landmark is in the map at all. Where there is no second landmark, s
    is taken for 2 d.

    Attributes:
        weights: w0, w1, w2.
    """

    weights: tuple[float, ...]

    def probability(self, distances: ArrayLike) -> NDArray[np.float64]:
        """(n, 2 or more) squared distances as `search` gives them -> (n,) float64.

        It is 0 where there is no landmark.
        """
        nearest, second = np.asarray(distances, np.float64)[:, :2].T
        there = nearest < NO_DISTANCE
        x = features(np.where(there, nearest, 0.0), second)
        return np.where(there, sigmoid(self.weights[0] + x @ np.array(self.weights[1:])), 0.0)

    @classmethod
    def of(cls, encoder: pm.Encoder, dim: int | None = None) -> Acceptance:
        """What an encoder's model file says of codes of `dim` numbers (None: all).

        An encoder that says nothing, but is equal to one that ships, takes over what that says.

        Raises:
            ValueError: it was never calibrated for codes of this length.
        """
        dim = dim or encoder.dim
        fitted = parse(encoder.notes.get(KEY, "")) or parse(_bundled_note(encoder))
        if dim not in fitted:
            raise ValueError(
                f"encoder '{encoder.name}' does not say which matches of {dim} numbers to accept: "
                "run `protomark calibrate MODEL TRACKS...` and build the map with that model"
            )
        return fitted[dim]


def features(nearest: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) and (n,) squared distances -> (n, 2): d^2 and s^2 - d^2."""
    return np.column_stack([nearest, np.where(second < NO_DISTANCE, second, 4 * nearest) - nearest])


def parse(note: str) -> dict[int, Acceptance]:
    """What the key `acceptance` says: a line for each length, the length and the weights.

    Raises:
        ValueError: it is none of this.
    """
    fitted = {}
    for line in note.splitlines():
        try:
            dim, *weights = line.split()
            values = tuple(float(w) for w in weights)
            if len(values) != _WEIGHTS or not np.isfinite(values).all():
                raise ValueError
            fitted[int(dim)] = Acceptance(values)
        except ValueError:
            raise ValueError(f"the model's note on {KEY} is broken: {line[:80]!r}") from None
    return fitted


def with_acceptance(
    encoder: pm.Encoder, fitted: Mapping[int, Acceptance], source: str
) -> pm.Encoder:
    """The same encoder with these notes; its identity, and so its codes, are the same.

    Args:
        encoder: the encoder.
        fitted: what was fitted for each length of a code.
        source: the sequences that it was fitted to.
    """
    lines = [
        " ".join([str(dim), *(f"{w:.6g}" for w in fitted[dim].weights)]) for dim in sorted(fitted)
    ]
    return pm.Encoder(
        encoder.layers,
        encoder.dims,
        encoder.name,
        encoder.descriptor,
        encoder.scale,
        encoder.data,
        encoder.licence,
        {**encoder.notes, KEY: "\n".join(lines), SOURCE_KEY: source},
    )


def _bundled_note(encoder: pm.Encoder) -> str:
    from protomark.models import names

    if encoder.name not in names():
        return ""
    bundled = pm.Encoder.load(encoder.name)
    return bundled.notes.get(KEY, "") if bundled.identity == encoder.identity else ""
