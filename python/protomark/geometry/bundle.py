"""Bundle adjustment: Levenberg-Marquardt on poses and lenses, points eliminated.

Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000, Section 6.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protomark.extras import optional
from protomark.geometry.neighbours import runs
from protomark.geometry.pose import camera_centers, rotate
from protomark.interrupt import raise_if_overdue

Array = NDArray[np.float64]
Ids = NDArray[np.int64]
Flags = NDArray[np.bool_]

# So many points are eliminated at a time, those together that the same frames see.
_CHUNK = 500
# Rows of a block of the reduced system.
_BLOCK = 240
# Adjustment ends with a step that lowers the loss by a smaller share.
_MIN_GAIN = 1e-4
# A point behind a camera counts as this many standard deviations off.
_BEHIND = 1e3


@dataclass
class Bundle:
    """f frames of c cameras, l points and n observations, to be adjusted.

    A camera of focal length f and distortion k sees the point (x, y, z) at f (1 + k r^2) (x, y) / z
    from its principal point, r^2 = (x^2 + y^2) / z^2.
    """

    poses: Array  # (f, 3, 4) float64, cam_from_world
    moving: Flags  # (f,) whether each pose moves
    camera: Ids  # (f,) int64, camera of each frame
    lenses: Array  # (c, 2) float64, focal length in pixels, and distortion
    refined: Flags  # (c, 2) whether focal length and distortion of each lens are refined
    points: Array  # (l, 3) float64
    frame: Ids  # (n,) int64, frame of each observation
    point: Ids  # (n,) int64, its point
    pixels: Array  # (n, 2) float64, relative to the principal point
    sigma: Array  # (n,) float64, standard deviation in pixels
    turns: Array | None = None  # (n, 3, 3) float64, see `Camera.local_rays`
    priors: Array | None = None  # (f, 3) float64, where cameras are likely to be
    spread: float = 1.0  # standard deviation of the priors along each axis

    def __post_init__(self) -> None:
        first = np.full(len(self.points), len(self.poses))
        np.minimum.at(first, self.point, self.frame)
        rank = np.empty(len(first), np.int64)
        rank[np.argsort(first, kind="stable")] = np.arange(len(first))
        chunk = rank // _CHUNK
        order = np.lexsort((self.frame, chunk[self.point]))
        for name in ("frame", "point", "pixels", "sigma"):
            setattr(self, name, getattr(self, name)[order])
        self.turns = None if self.turns is None else self.turns[order]
        chunks = chunk[self.point]
        self._chunks = _slices(chunks)
        # The observations of one chunk in one frame.
        self._blocks = _slices(chunks * len(self.poses) + self.frame)
        self._lens_of = self.camera[self.frame]
        # Rows of the reduced system: six for each moving pose, then two for each lens.
        self._first_lens = 6 * int(self.moving.sum())
        self._size = self._first_lens + 2 * len(self.lenses) * bool(self.refined.any())
        self._column = np.where(self.moving, np.cumsum(self.moving) - 1, -1)

    def adjust(self, iterations: int, loss_scale: float = 1.0) -> float:
        """Move poses, points and lenses to the least (Cauchy) reprojection error; returns the loss.

        Args:
            iterations: limit on the steps.
            loss_scale: standard deviations beyond which an error counts less.
        """
        damping = 1e-4
        state = self._evaluate(loss_scale)
        for _ in range(iterations):
            raise_if_overdue()
            before = self.poses, self.points, self.lenses
            try:
                self._step(*state[1:], damping)
                after = self._evaluate(loss_scale)
            except np.linalg.LinAlgError:
                after = (np.inf, *state[1:])
            if not after[0] <= state[0]:
                self.poses, self.points, self.lenses = before
                damping = min(10 * damping, 1e6)
                continue
            gain, state = state[0] - after[0], after
            damping = max(0.1 * damping, 1e-9)
            if gain <= _MIN_GAIN * state[0]:
                break
        return state[0]

    def errors(self) -> Array:
        """Reprojection errors (n,) in pixels, in the order of `frame` and `point`."""
        _, local, error, _ = self._evaluate(1.0)
        return np.where(local[2] > 0, np.linalg.norm(error, axis=0), np.inf)

    def focal_deviations(self) -> Array:
        """Relative standard deviation (c,) of each focal length, infinite if it is open.

        All else is free, and the errors say how accurate a keypoint is.
        """
        _, local, difference, weight = self._evaluate(1.0)
        reduced = self._reduce(local, difference, weight, 1e-9)[0]
        error = np.linalg.norm(difference, axis=0) / self.sigma
        # The mean length of an error with this deviation in x and in y is sqrt(pi / 2) times it.
        noise = float(error.mean()) / np.sqrt(np.pi / 2)
        variances = []
        for row in range(self._first_lens, self._size, 2):
            unit = np.zeros(self._size)
            unit[row] = 1
            try:
                variances.append(_solve(reduced.copy(), unit)[row])
            except np.linalg.LinAlgError:
                variances.append(np.inf)
        return np.asarray(noise * np.sqrt(variances) / self.lenses[:, 0])

    def _evaluate(self, loss_scale: float) -> tuple[float, Array, Array, Array]:
        """The loss, points in their cameras (3, n), errors (2, n) in pixels and weights (n,)."""
        local = self.points.T[:, self.point]
        for a, b in self._blocks:
            pose = self.poses[self.frame[a]]
            local[:, a:b] = pose[:, :3] @ local[:, a:b] + pose[:, 3:]
        if self.turns is not None:
            local = np.einsum("nij,jn->in", self.turns, local)
        front = local[2] > 1e-9
        local[:, ~front] = [[0], [0], [1]]
        rays = local[:2] / local[2]
        focal, distortion = self.lenses[self._lens_of].T
        error = focal * (1 + distortion * (rays * rays).sum(0)) * rays - self.pixels.T
        square = (error * error).sum(0) / self.sigma**2
        square[~front] = _BEHIND**2
        square /= loss_scale**2
        weight = np.where(front, 1 / (self.sigma * np.sqrt(1 + square)), 0.0)
        loss = float(np.log1p(square).sum()) if (self.lenses[:, 0] > 0).all() else np.inf
        if self.priors is not None:
            loss += float((self._off_priors() ** 2).sum())
        return loss, local, error, weight

    def _off_priors(self) -> Array:
        """Distances (f, 3) of the cameras from their priors, in standard deviations."""
        assert self.priors is not None
        return (camera_centers(self.poses) - self.priors) / self.spread

    def _step(self, local: Array, error: Array, weight: Array, damping: float) -> None:
        """Solve the normal equations, and move everything by the solution."""
        reduced, target, by_motion, by_point, gradient, root = self._reduce(
            local, error, weight, damping
        )
        step = -_solve(reduced, target)
        motions = np.zeros((len(self.poses), by_motion.shape[1]))
        motions[self.moving, :6] = step[: self._first_lens].reshape(-1, 6)
        lenses = step[self._first_lens :].reshape(-1, 2)
        if len(lenses):
            motions[:, 6:] = lenses[self.camera]
            self.lenses = self.lenses + lenses
        shift = np.empty_like(error)
        for a, b in self._blocks:
            shift[:, a:b] = motions[self.frame[a]] @ by_motion[:, :, a:b]
        gradient += self._by_landmark((by_point * shift[:, None]).sum(0))
        # The root is upper triangular, and its columns are packed.
        xx, xy, xz, yy, yz, zz = root
        x, y, z = gradient
        self.points = self.points - np.stack([xx * x + xy * y + xz * z, yy * y + yz * z, zz * z], 1)
        cv2 = optional("cv2")
        self.poses = self.poses.copy()
        for i in np.flatnonzero(self.moving).tolist():
            self.poses[i] = cv2.Rodrigues(motions[i, :3])[0] @ self.poses[i]
            self.poses[i, :, 3] += motions[i, 3:6]

    def _by_landmark(self, values: Array) -> Array:
        """Sums (k, l) by point of values (k, n)."""
        count = len(self.points)
        return np.stack([np.bincount(self.point, row, minlength=count) for row in values])

    def _reduce(
        self, local: Array, error: Array, weight: Array, damping: float
    ) -> tuple[Array, Array, Array, Array, Array, Array]:
        """The normal equations without the points, and what gives the points' share.

        Returns matrix and right side; derivatives by the frame's motion and by its point; and the
        gradient by points and the root of their covariance.
        """
        residual = error * weight
        by_motion, by_point = self._derivatives(local, weight)
        pairs = [(i, j) for i in range(3) for j in range(i, 3)]
        products = [(by_point[:, i] * by_point[:, j]).sum(0) for i, j in pairs]
        products += [(by_point[:, i] * residual).sum(0) for i in range(3)]
        sums = self._by_landmark(np.stack(products))
        root = _root(sums[:6], damping)
        # In units of the root, the normal matrix of a point is the identity.
        xx, xy, xz, yy, yz, zz = root
        x, y, z = sums[6:]
        gradient = np.stack([xx * x, xy * x + yy * y, xz * x + yz * y + zz * z])
        xx, xy, xz, yy, yz, zz = root[:, self.point]
        by_point[:, 2] = by_point[:, 0] * xz + by_point[:, 1] * yz + by_point[:, 2] * zz
        by_point[:, 1] = by_point[:, 0] * xy + by_point[:, 1] * yy
        by_point[:, 0] *= xx

        reduced, target = np.zeros((self._size, self._size)), np.zeros(self._size)
        for a, b in self._blocks:
            jacobian = np.concatenate(by_motion[:, :, a:b], axis=1)
            normal, slope = jacobian @ jacobian.T, jacobian @ residual[:, a:b].reshape(-1)
            blocks = self._rows(self.frame[a])
            for i, to in blocks:
                target[to] += slope[i]
                for j, across in blocks:
                    reduced[to, across] += normal[i, j]
        diagonal = np.einsum("ii->i", reduced)
        if self.priors is not None:
            slopes = -rotate(self.poses[:, :, :3], self._off_priors()) / self.spread
            of_centers = np.arange(self._first_lens).reshape(-1, 6)[:, 3:].ravel()
            diagonal[of_centers] += 1 / self.spread**2
            target[of_centers] += slopes[self.moving].ravel()
        diagonal *= 1 + damping
        diagonal += 1e-12
        for rows, points, coupling in self._couplings(by_motion, by_point):
            reduced[rows[:, None], rows] -= coupling @ coupling.T
            target[rows] -= coupling @ gradient[:, points].reshape(-1)
        return reduced, target, by_motion, by_point, gradient, root

    def _rows(self, frame: int) -> list[tuple[slice, slice]]:
        """Where derivatives by a frame's motion belong in the reduced system."""
        out, lens = [], self._first_lens + 2 * int(self.camera[frame])
        if self.moving[frame]:
            out.append((slice(6), slice(6 * self._column[frame], 6 * self._column[frame] + 6)))
        if lens < self._size:
            out.append((slice(6, 8), slice(lens, lens + 2)))
        return out

    def _couplings(self, by_motion: Array, by_point: Array) -> Iterator[tuple[Ids, Ids, Array]]:
        """For each chunk: rows (r,), points (p,), and what couples them (r, 3 p)."""
        width = by_motion.shape[1]
        for a, b in self._chunks:
            used = np.arange(a, b)
            if width == 6:
                used = used[self.moving[self.frame[a:b]]]
            points, point = np.unique(self.point[used], return_inverse=True)
            frames, frame = np.unique(self.frame[used], return_inverse=True)
            coupling = np.zeros((len(frames), width, 3, len(points)))
            motion, at = by_motion[:, :, used], by_point[:, :, used]
            for i in range(width):
                for j in range(3):
                    coupling[frame, i, j, point] = motion[0, i] * at[0, j] + motion[1, i] * at[1, j]
            moving = self.moving[frames]
            rows = (6 * self._column[frames[moving], None] + np.arange(6)).ravel()
            parts = [coupling[moving, :6].reshape(len(rows), 3 * len(points))]
            if width > 6:
                for camera in range(len(self.lenses)):
                    seen = coupling[self.camera[frames] == camera, 6:]
                    parts.append(seen.sum(0).reshape(2, -1))
                rows = np.r_[rows, self._first_lens : self._size]
            yield rows, points, np.concatenate(parts)

    def _derivatives(self, local: Array, weight: Array) -> tuple[Array, Array]:
        """Weighted derivatives of pixels by a frame's motion (2, 6 or 8, n), and by points.

        A motion is a rotation, then a translation of the camera, and a change of its lens.
        """
        inverse = 1 / local[2]
        u, v = rays = local[:2] * inverse
        focal, distortion = self.lenses[self._lens_of].T
        square = u * u + v * v
        stretch = weight * (1 + distortion * square)
        scale = focal * stretch
        out = np.zeros((2, 6 if self._size == self._first_lens else 8, len(u)))
        out[0, 0] = -scale * u * v
        out[0, 1] = scale * (1 + u * u)
        out[0, 2] = -scale * v
        out[1, 0] = -scale * (1 + v * v)
        out[1, 1] = -out[0, 0]
        out[1, 2] = scale * u
        scale *= inverse
        out[0, 3] = out[1, 4] = scale
        out[:, 5] = -scale * rays
        if self.lenses[:, 1].any():
            along = (u * out[0, :6] + v * out[1, :6]) * (2 * distortion / (1 + distortion * square))
            out[:, :6] += rays[:, None] * along
        if out.shape[1] > 6:
            of_focal, of_distortion = self.refined[self._lens_of].T
            out[:, 6] = of_focal * stretch * rays
            out[:, 7] = of_distortion * weight * focal * square * rays
        if self.turns is not None:
            for part in (slice(3), slice(3, 6)):
                out[:, part] = np.einsum("rin,nij->rjn", out[:, part], self.turns)
        by_point = np.empty((2, 3, len(u)))
        for a, b in self._blocks:
            by_point[:, :, a:b] = self.poses[self.frame[a], :, :3].T @ out[:, 3:6, a:b]
        return out, by_point


def _slices(values: Ids) -> list[tuple[int, int]]:
    """Start and end of each run of equal entries in a sorted array."""
    starts, lengths = runs(values)
    return list(zip(starts.tolist(), (starts + lengths).tolist(), strict=True))


def _solve(matrix: Array, target: Array) -> Array:
    """The solution of a positive definite system, by Cholesky; the matrix is overwritten.

    Blocks that are zero, as of frames that see nothing in common, cost nothing.
    """
    ends = range(_BLOCK, len(target) + _BLOCK, _BLOCK)
    blocks = [slice(end - _BLOCK, min(end, len(target))) for end in ends]
    out, roots, below = target.copy(), [], []
    for k, block in enumerate(blocks):
        root = np.linalg.inv(np.linalg.cholesky(matrix[block, block]))
        out[block] = root @ out[block]
        rows = [i for i in blocks[k + 1 :] if matrix[i, block].any()]
        for n, i in enumerate(rows):
            matrix[i, block] = matrix[i, block] @ root.T
            out[i] -= matrix[i, block] @ out[block]
            for j in rows[: n + 1]:
                matrix[i, j] -= matrix[i, block] @ matrix[j, block].T
        roots.append(root)
        below.append(rows)
    for block, root, rows in zip(blocks[::-1], roots[::-1], below[::-1], strict=True):
        for i in rows:
            out[block] -= matrix[i, block].T @ out[i]
        out[block] = root.T @ out[block]
    return out


def _root(normal: Array, damping: float) -> Array:
    """R with R R^T = (N + damping diag N)^-1 for packed matrices (6, l): xx, xy, xz, yy, yz, zz."""
    xx, xy, xz, yy, yz, zz = normal
    least = 1e-12 * (xx + yy + zz) + 1e-12
    xx, yy, zz = (d * (1 + damping) + least for d in (xx, yy, zz))
    # N = C C^T with C lower triangular (Cholesky), and R is the inverse of C^T.
    a = np.sqrt(xx)
    b, c = xy / a, xz / a
    d = np.sqrt(np.maximum(yy - b * b, least))
    e = (yz - b * c) / d
    f = np.sqrt(np.maximum(zz - c * c - e * e, least))
    return np.stack(
        [1 / a, -b / (a * d), (b * e - c * d) / (a * d * f), 1 / d, -e / (d * f), 1 / f]
    )
