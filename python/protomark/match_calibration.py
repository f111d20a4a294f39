"""The probability that a keypoint's nearest landmark is right, given the two nearest distances.

Many keypoints of a real frame have no landmark in the map, and their nearest one is wrong however
good the descriptor is. A fixed ratio test (Lowe, IJCV 2004) accepts a different share of right
matches for each encoder and code length. Therefore the probability is fitted to data for each of
them (`protomark.training.match_calibration`), and the model file stores the fit in its `info`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark._core import MatchCalibration as MatchCalibration

KEY, TUNED_KEY = "match_calibration", "match_calibration_tuned"
SOURCE_KEY = "match_calibration_data"
# The squared distance that search returns where there is no landmark.
NO_DISTANCE = np.iinfo(np.int32).max
# Keeps weights finite if the features separate right from wrong completely.
_RIDGE = 1e-4
_STEPS = 50


def calibration_features(
    nearest: NDArray[np.float64], second: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Features (n, 2) of squared distances (n,): d^2 and s^2 - d^2."""
    return np.column_stack([nearest, np.where(second < NO_DISTANCE, second, 4 * nearest) - nearest])


def with_calibration(
    encoder: pm.Encoder,
    # By code length, and whether prototypes are tuned.
    fitted: Mapping[tuple[int, bool], MatchCalibration],
    source: str,
) -> pm.Encoder:
    """A copy of an encoder with a calibration; identity and codes are the same."""
    lines: dict[str, list[str]] = {KEY: [], TUNED_KEY: []}
    for (dim, tuned), calibration in sorted(fitted.items(), key=lambda item: item[0]):
        weights = (f"{w:.6g}" for w in calibration.weights)
        lines[TUNED_KEY if tuned else KEY].append(" ".join([str(dim), *weights]))
    notes = {key: "\n".join(of_key) for key, of_key in lines.items() if of_key}
    return pm.Encoder(
        encoder.layers,
        encoder.dims,
        encoder.name,
        encoder.descriptor,
        encoder.scale,
        encoder.data,
        encoder.licence,
        {**encoder.notes, **notes, SOURCE_KEY: source},
        encoder.codebooks,
        encoder.input,
        encoder.input_scale,
    )


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
