"""Logistic regression: the probability of yes from a few numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Keeps weights finite where numbers tell yes from no without exception.
_RIDGE = 1e-4
_STEPS = 50


def fit(
    features: NDArray[np.float64], right: NDArray[np.bool_], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Weights w of P(yes) = 1 / (1 + exp(-w0 - w1 x1 - w2 x2 ...)), by Newton's method.

    Args:
        features: (n, f) float64, x.
        right: (n,) bool, yes or no.
        weights: (n,) float64, how much each row counts.

    Returns:
        (f + 1,) float64, the constant first.

    Raises:
        ValueError: there is no yes, or no no.
    """
    if not right.any() or right.all():
        raise ValueError(f"{int(right.sum())} of {len(right)} are right: nothing to tell apart")
    share = weights / weights.sum()
    mean = share @ features
    spread = np.maximum(np.sqrt(share @ (features - mean) ** 2), 1e-12)
    x = np.column_stack([np.ones(len(features)), (features - mean) / spread])
    w = np.zeros(x.shape[1])
    penalty = np.full(len(w), _RIDGE)
    penalty[0] = 0
    for _ in range(_STEPS):
        p = sigmoid(x @ w)
        gradient = x.T @ (share * (p - right)) + penalty * w
        hessian = (x * (share * p * (1 - p))[:, None]).T @ x + np.diag(penalty + 1e-12)
        step = np.linalg.solve(hessian, gradient)
        # A long step overshoots where the classes are far apart.
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
