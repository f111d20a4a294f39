"""Similarities between two worlds: scale, rotation and translation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Points on a line leave the rotation about it open: their second spread is below this share.
_MIN_SPREAD = 1e-3
_TRIPLES = 3000
# A triple's sides may differ in scale by this factor, or it is no similar triangle.
_TRIANGLE = 1.25
# Triples of one batch, how many similar triangles of it are tried, how many of these should agree
# before the search ends, and coordinates to compute at once.
_BATCH = 1024
_MAX_TRIED = 200
_SURE = 20.0
_MAX_NUMBERS = 4_000_000


@dataclass(frozen=True)
class Similarity:
    """The similarity x' = scale * rotation @ x + translation."""

    scale: float
    rotation: Array  # (3, 3) float64
    translation: Array  # (3,) float64

    def __call__(self, points: Array) -> Array:
        """Move points (n, 3)."""
        return np.asarray(self.scale * points @ self.rotation.T + self.translation)

    def inverse(self) -> Similarity:
        """The similarity that moves back."""
        back = self.rotation.T / self.scale
        return Similarity(1 / self.scale, self.rotation.T, -back @ self.translation)

    def move_poses(self, cam_from_world: Array) -> Array:
        """The poses (..., 3, 4) of the same cameras in the other world."""
        rotation = cam_from_world[..., :3] @ self.rotation.T
        moved = self.scale * cam_from_world[..., 3] - rotation @ self.translation
        return np.concatenate([rotation, moved[..., None]], axis=-1)

    @property
    def degrees(self) -> float:
        """The angle of the rotation."""
        chord = np.linalg.norm(self.rotation - np.eye(3)) / np.sqrt(8)
        return float(np.degrees(2 * np.arcsin(min(float(chord), 1.0))))


def fit_similarity(
    source: Array, target: Array, weights: Array | None = None, *, fixed_scale: bool = False
) -> Similarity:
    """The similarity that brings points (n, 3) closest to others (n, 3), by weighted squares.

    It is the least-squares solution of Umeyama, Least-squares estimation of transformation
    parameters between two point patterns (1991), Eq. 40 to 43.

    Raises:
        ValueError: there are fewer than three points, the numbers differ, or all source points
            coincide.
    """
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise ValueError(f"points have shapes {source.shape} and {target.shape}, not twice (n, 3)")
    if len(source) < 3:
        raise ValueError(f"{len(source)} points are common, but alignment needs three")
    if np.ptp(source, axis=0).max() <= 1e-12 * max(1.0, np.abs(source).max()):
        raise ValueError("all points have the same position, so the scale is undefined")
    weights = np.ones(len(source)) if weights is None else weights
    scale, rotation, translation = _fit(source, target, weights, fixed_scale)
    return Similarity(float(scale), rotation, translation)


def _fit(
    source: Array, target: Array, weights: Array, fixed_scale: bool
) -> tuple[Array, Array, Array]:
    """Scales (...,), rotations (..., 3, 3) and translations (..., 3) of points (..., n, 3)."""
    share = (weights / weights.sum(-1, keepdims=True))[..., None]
    middle_a, middle_b = (share * source).sum(-2), (share * target).sum(-2)
    a, b = source - middle_a[..., None, :], target - middle_b[..., None, :]
    u, d, vt = np.linalg.svd(np.swapaxes(b, -1, -2) @ (share * a))
    sign = np.ones_like(d)
    sign[..., 2] = np.where(np.linalg.det(u) * np.linalg.det(vt) < 0, -1.0, 1.0)
    rotation = (u * sign[..., None, :]) @ vt
    variance = (share * a * a).sum((-1, -2))
    scale = np.ones_like(variance) if fixed_scale else (d * sign).sum(-1) / variance
    translation = middle_b - scale[..., None] * (rotation @ middle_a[..., None])[..., 0]
    return scale, rotation, translation


def fit_robustly(
    source: Array, target: Array, *, fixed_scale: bool = False
) -> tuple[Similarity, NDArray[np.bool_]]:
    """The similarity that brings most points (n, 3) close to others, and which points (n,) it does.

    It is the least median of squares over triples (Rousseeuw, Least median of squares regression,
    1984), refined on the points within 2.5 robust standard deviations.

    Raises:
        ValueError: as `fit_similarity`; or the points lie on a line, so that the rotation about it
            stays open.
    """
    one = fit_similarity(source, target, fixed_scale=fixed_scale)
    n = len(source)
    rows = np.random.default_rng(0).integers(0, n, (_TRIPLES, 3))
    rows = rows[_similar_triangles(source[rows], target[rows], fixed_scale, 2.0)]
    motions = _fit(source[rows], target[rows], np.ones(rows.shape), fixed_scale)
    candidates = [Similarity(float(s), r, t) for s, r, t in zip(*motions, strict=True)]
    medians = [np.median(np.linalg.norm(c(source) - target, axis=1)) for c in candidates]
    if medians:
        one = candidates[int(np.argmin(medians))]
    inliers = np.ones(n, bool)
    for _ in range(10):
        errors = np.linalg.norm(one(source) - target, axis=1)
        deviation = 1.4826 * (1 + 5 / max(n - 3, 1)) * float(np.median(errors))
        now = errors <= 2.5 * deviation + 1e-9 * float(np.ptp(target, axis=0).max())
        if now.sum() < 3 or (now == inliers).all():
            break
        inliers = now
        one = fit_similarity(source[inliers], target[inliers], fixed_scale=fixed_scale)
    for points in (source[inliers], target[inliers]):
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if spread[1] <= _MIN_SPREAD * spread[0]:
            raise ValueError("the points lie on a line, so the rotation about it is undefined")
    return one, inliers


@dataclass(frozen=True)
class Consensus:
    """What most of n point pairs agree on.

    Attributes:
        similarity: moves source points to target points.
        inliers: (n,) bool, the pairs that agree.
        limit: how far apart moved and target points of these may be, as a share of the reach.
        chance: log10 of how many such sets pairs without relation would give (Moisan and Stival,
            A probabilistic criterion to detect rigid point matches, IJCV 2004).
    """

    similarity: Similarity
    inliers: NDArray[np.bool_]
    limit: float
    chance: float


def find_similarity(
    source: Array,
    target: Array,
    reach: tuple[float, float],
    limits: tuple[float, ...],
    *,
    fixed_scale: bool = False,
    samples: int,
) -> Consensus | None:
    """The similarity on which the least explicable set of point pairs agrees; None without any.

    Triples are drawn from the best pairs first (Chum and Matas, Matching with PROSAC, CVPR 2005),
    and each new best similarity is refined on the pairs that agree with it (Chum, Matas and
    Kittler, Locally optimized RANSAC, 2003). A pair agrees if its points are near each other in
    both worlds, so that no similarity wins by shrinking one of them.

    Args:
        source: (n, 3) points, those of the best pairs first.
        target: (n, 3) points.
        reach: the size of the source's and of the target's world.
        limits: shares of the reach within which pairs may agree, of which one is chosen.
        fixed_scale: whether the scale is 1.
        samples: number of triples.
    """
    n = len(source)
    if n < 4:
        return None
    rng = np.random.default_rng(0)
    near = np.array([_near_by_chance(target, limit * reach[1]) for limit in limits])
    score = _Score(source, target, reach, np.array(limits), near)
    best: tuple[float, Similarity | None] = (0.0, None)
    batches = -(-samples // _BATCH)
    together = max(1, _MAX_NUMBERS // (3 * n))
    for batch in range(batches):
        # The pool of pairs grows from the first twenty to all over the first half of the batches.
        pool = n if 2 * batch >= batches else min(n, int(20 * (n / 20) ** (2 * batch / batches)))
        rows = rng.integers(0, max(4, pool), (_BATCH, 3)) % n
        rows = rows[_similar_triangles(source[rows], target[rows], fixed_scale)]
        tried = _BATCH * min(1.0, _MAX_TRIED / max(len(rows), 1))
        rows = rows[:_MAX_TRIED]
        for low in range(0, len(rows), together):
            part = rows[low : low + together]
            motions = _fit(source[part], target[part], np.ones(part.shape), fixed_scale)
            chance, _ = score.of(*motions)
            i = int(chance.argmin())
            if chance[i] < best[0]:
                scale, rotation, translation = (m[i] for m in motions)
                found = _refine(score, Similarity(float(scale), rotation, translation), fixed_scale)
                best = min(best, found, key=lambda one: one[0])
        if best[1] is not None:
            # Triples of this pool have missed a better set with a probability below 10^-9.
            share = (score.errors_of(best[1])[:pool] <= limits[score.of_one(best[1])[1]]).mean()
            if tried * share**3 > _SURE:
                break
    if best[1] is None:
        return None
    least, level = score.of_one(best[1])
    inliers = score.errors_of(best[1]) <= limits[level]
    return Consensus(best[1], inliers, limits[level], least)


@dataclass(frozen=True)
class _Score:
    source: Array
    target: Array
    reach: tuple[float, float]
    limits: Array  # (l,)
    near: Array  # (l,) share of unrelated points within a limit

    def errors(self, scale: Array, rotation: Array, translation: Array) -> Array:
        """Distances (h, n) of moved and target points, as shares of the smaller reach."""
        moved = scale[:, None, None] * (self.source @ np.swapaxes(rotation, -1, -2))
        moved += translation[:, None] - self.target
        distance = np.sqrt(np.einsum("hni,hni->hn", moved, moved))
        return np.asarray(distance / np.minimum(self.reach[1], scale * self.reach[0])[:, None])

    def of(self, scale: Array, rotation: Array, translation: Array) -> tuple[Array, Array]:
        """For each similarity the least `Consensus.chance` (h,), and its limit's index (h,)."""
        errors = self.errors(scale, rotation, translation)
        n = errors.shape[1]
        agreeing = np.stack([(errors <= limit).sum(axis=1) for limit in self.limits], axis=1)
        chance = _log_chance(agreeing, n, self.near) + np.log10(n * len(self.limits))
        level = chance.argmin(axis=1)
        return chance[np.arange(len(level)), level], level

    def of_one(self, one: Similarity) -> tuple[float, int]:
        chance, level = self.of(np.array([one.scale]), one.rotation[None], one.translation[None])
        return float(chance[0]), int(level[0])

    def errors_of(self, one: Similarity) -> Array:
        return self.errors(np.array([one.scale]), one.rotation[None], one.translation[None])[0]


def _refine(score: _Score, one: Similarity, fixed_scale: bool) -> tuple[float, Similarity]:
    """Fit to the pairs that agree, those that agree well with more weight, while that helps."""
    chance, level = score.of_one(one)
    for _ in range(10):
        share = score.errors_of(one) / score.limits[level]
        weights = np.maximum(1 - share * share, 0) ** 2  # Tukey's biweight
        if np.count_nonzero(weights) < 4:
            break
        scale, rotation, translation = _fit(score.source, score.target, weights, fixed_scale)
        better = Similarity(float(scale), rotation, translation)
        now, level = score.of_one(better)
        if now >= chance:
            break
        one, chance = better, now
    return chance, one


def _log_chance(agreeing: NDArray[np.int64], n: int, near: Array) -> Array:
    """log10 of (n - 3) C(n, k) C(k, 3) near^(k - 3): sets of k agreeing pairs by chance."""
    table = np.concatenate([[0.0], np.cumsum(np.log10(np.arange(1, n + 1)))])
    k = np.maximum(agreeing, 3)
    subsets = table[n] - table[k] - table[n - k] + table[k] - table[3] - table[k - 3]
    return np.asarray(subsets + (k - 3) * np.log10(np.clip(near, 1e-12, 1)))


def _near_by_chance(points: Array, radius: float, sample: int = 1000) -> float:
    """Share of the pairs of points (n, 3) that are within a radius."""
    some = points[:: -(-len(points) // sample)]
    distances = np.linalg.norm(some[:, None] - some, axis=2)
    close = np.count_nonzero(distances <= radius) - len(some)
    return (close + 1) / (len(some) * (len(some) - 1) + 1)


def _similar_triangles(
    source: Array, target: Array, fixed_scale: bool, factor: float = _TRIANGLE
) -> NDArray[np.bool_]:
    """Whether the triangles (h, 3, 3) of two worlds have sides of one scale."""
    a, b = (np.linalg.norm(p - np.roll(p, 1, axis=1), axis=2) for p in (source, target))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = b / a
        similar = ratio.max(1) < factor * ratio.min(1)
        if fixed_scale:
            similar &= (ratio.max(1) < factor) & (ratio.min(1) > 1 / factor)
    return np.asarray(similar & (a.min(1) > 0) & (b.min(1) > 0))
