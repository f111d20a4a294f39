"""The probability that a keypoint's nearest landmark is right, given the two nearest distances.

Many keypoints of a real frame have no landmark in the map, and their nearest one is wrong however
good the descriptor is. A fixed ratio test (Lowe, IJCV 2004) accepts a different share of right
matches for each encoder and code length. Therefore the probability is fitted to data for each of
them (`protomark.training.match_calibration`), and the model file stores the fit in its `info`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

import protomark as pm

KEY = "match_calibration"
SOURCE_KEY = "match_calibration_data"
# The squared distance that search returns where there is no landmark.
NO_DISTANCE = np.iinfo(np.int32).max
_WEIGHTS = 3
# Keeps weights finite if the features separate right from wrong completely.
_RIDGE = 1e-4
_STEPS = 50


@dataclass(frozen=True)
class MatchCalibration:
    """P(right) = 1 / (1 + exp(-(w0 + w1 d^2 + w2 (s^2 - d^2)))).

    d and s are the distances to the nearest and to the second nearest landmark, in code units.
    Training makes exp(-distance^2 / T) the likelihood of a landmark (Snell et al., Prototypical
    Networks, NeurIPS 2017), so the margin between two landmarks is a difference of squares, while d
    alone tells whether the keypoint's landmark is in the map. Without a second landmark s is 2 d.

    Attributes:
        weights: w0, w1, w2.
    """

    weights: tuple[float, ...]

    def probability(self, distances: ArrayLike) -> NDArray[np.float64]:
        """Probabilities (n,) float64 that the nearest landmarks are right, 0 where there is none.

        Args:
            distances: (n, k) squared distances with k >= 2, as `search` returns them.
        """
        nearest, second = np.asarray(distances, np.float64)[:, :2].T
        present = nearest < NO_DISTANCE
        x = calibration_features(np.where(present, nearest, 0.0), second)
        return np.where(present, sigmoid(self.weights[0] + x @ np.array(self.weights[1:])), 0.0)

    @classmethod
    def of(cls, encoder: pm.Encoder, dim: int | None = None) -> MatchCalibration:
        """The calibration in an encoder's model file for codes of `dim` numbers (None: all).

        An encoder without a calibration has that of the bundled encoder with the same identity.

        Raises:
            ValueError: the encoder was never calibrated for codes of this length.
        """
        dim = dim or encoder.dim
        fitted = parse(encoder.notes.get(KEY, "")) or parse(_bundled_note(encoder))
        if dim not in fitted:
            raise ValueError(
                f"encoder '{encoder.name}' has no match calibration for codes of {dim} numbers: "
                "run `protomark calibrate MODEL TRACKS...` and build the map with that model"
            )
        return fitted[dim]


def calibration_features(
    nearest: NDArray[np.float64], second: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Features (n, 2) of squared distances (n,): d^2 and s^2 - d^2."""
    return np.column_stack([nearest, np.where(second < NO_DISTANCE, second, 4 * nearest) - nearest])


def parse(note: str) -> dict[int, MatchCalibration]:
    """Read the note in a model file, whose lines hold a code length and the weights.

    Raises:
        ValueError: the note is broken.
    """
    fitted = {}
    for line in note.splitlines():
        try:
            dim, *weights = line.split()
            values = tuple(float(w) for w in weights)
            if len(values) != _WEIGHTS or not np.isfinite(values).all():
                raise ValueError
            fitted[int(dim)] = MatchCalibration(values)
        except ValueError:
            raise ValueError(
                f"the model's note on {KEY} is broken, calibrate it anew: {line[:80]!r}"
            ) from None
    return fitted


def with_calibration(
    encoder: pm.Encoder, fitted: Mapping[int, MatchCalibration], source: str
) -> pm.Encoder:
    """A copy of an encoder with a calibration; identity and codes are the same.

    Args:
        encoder: the encoder.
        fitted: the calibration for each code length.
        source: the sequences that the calibration was fitted to.
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


def fit_logistic(
    features: NDArray[np.float64], labels: NDArray[np.bool_], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Weights w of P(label) = sigmoid(w0 + w1 x1 + w2 x2 ...), by Newton's method.

    Args:
        features: (n, f) float64, x.
        labels: (n,) bool.
        weights: (n,) float64, weight of each row.

    Returns:
        (f + 1,) float64, the constant first.

    Raises:
        ValueError: all labels are the same.
    """
    if not labels.any() or labels.all():
        raise ValueError(
            f"{int(labels.sum())} of {len(labels)} matches are right, but a fit needs right and "
            "wrong ones: give more tracks"
        )
    share = weights / weights.sum()
    mean = share @ features
    spread = np.maximum(np.sqrt(share @ (features - mean) ** 2), 1e-12)
    x = np.column_stack([np.ones(len(features)), (features - mean) / spread])
    w = np.zeros(x.shape[1])
    penalty = np.full(len(w), _RIDGE)
    penalty[0] = 0
    for _ in range(_STEPS):
        p = sigmoid(x @ w)
        gradient = x.T @ (share * (p - labels)) + penalty * w
        hessian = (x * (share * p * (1 - p))[:, None]).T @ x + np.diag(penalty + 1e-12)
        step = np.linalg.solve(hessian, gradient)
        # A long step overshoots if the classes are far apart.
        w -= step * min(1.0, 4.0 / max(float(np.abs(step).max()), 1e-12))
        if np.abs(step).max() < 1e-8:
            break
    w[1:] /= spread
    w[0] -= w[1:] @ mean
    return w


def sigmoid(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """1 / (1 + exp(-x)) without overflow."""
    e = np.exp(-np.abs(x))
    return np.where(x >= 0, 1.0, e) / (1 + e)
