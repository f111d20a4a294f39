"""The map from above, and where query keyframes were found in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from protomark.evaluation.plot import GRID, INK, MUTED, OURS
from protomark.localization.absolute_pose import centre

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LANDMARK, _TRUE = "#c3c9d3", "#dc2626"
# Share of landmarks left outside of the picture on every side: reconstructions have stray points.
_STRAY = 0.03


@dataclass(frozen=True)
class ScenePicture:
    """What is drawn.

    Attributes:
        landmarks: (l, 3) positions of the map.
        matched: (n, 3) positions that support some query's pose.
        support: (s, 3, 4) poses of the keyframes that built the map.
        true: (q, 3, 4) true poses of the query keyframes.
        estimated: one (3, 4) pose for each of them, None where none was found.
    """

    landmarks: NDArray[np.float64]
    matched: NDArray[np.float64]
    support: NDArray[np.float64]
    true: NDArray[np.float64]
    estimated: list[NDArray[np.float64] | None]


def draw_scene(axes: Axes, picture: ScenePicture, title: str = "") -> None:
    """Draw landmarks, matched landmarks, and true and estimated query poses from above."""
    poses = np.concatenate([picture.support, picture.true])
    plane = view_from_above(poses)
    middle = np.median(picture.landmarks, axis=0)

    def flat(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((points - middle) @ plane.T)

    def dots(points: NDArray[np.float64], **style: Any) -> None:
        x, y = flat(points).T
        axes.scatter(x, y, **style)

    def heads(cameras: NDArray[np.float64], length: float, **style: Any) -> None:
        starts = flat(centre(cameras))
        for start, end in zip(starts, starts + length * (cameras[:, 2, :3] @ plane.T), strict=True):
            axes.plot([start[0], end[0]], [start[1], end[1]], **style)

    landmarks, queries = flat(picture.landmarks), flat(centre(picture.true))
    low = np.minimum(np.quantile(landmarks, _STRAY, axis=0), queries.min(axis=0))
    high = np.maximum(np.quantile(landmarks, 1 - _STRAY, axis=0), queries.max(axis=0))
    size = float((high - low).max())
    found = np.array([pose for pose in picture.estimated if pose is not None]).reshape(-1, 3, 4)

    dots(picture.landmarks, s=4, color=_LANDMARK, linewidths=0, label="landmark")
    dots(picture.matched, s=5, color=OURS, linewidths=0, label="landmark matched by a query")
    cameras = centre(picture.support)
    dots(cameras, s=12, color=MUTED, marker="^", linewidths=0, label="support keyframe")
    heads(picture.true, 0.08 * size, color=_TRUE, linewidth=1.2, zorder=3)
    ring = {"facecolors": "none", "edgecolors": _TRUE, "linewidths": 1.4}
    dots(centre(picture.true), s=80, zorder=4, label="query, true pose", **ring)
    heads(found, 0.055 * size, color=INK, linewidth=2.4, zorder=5)
    dots(centre(found), s=18, color=INK, linewidths=0, zorder=6, label="query, estimated pose")

    (x, y), half = (low + high) / 2, 0.56 * size
    axes.set_xlim(x - half, x + half)
    axes.set_ylim(y - half, y + half)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_color(GRID)
    axes.set_title(title, loc="left", color=INK, fontsize=11, fontweight="bold")
    axes.legend(
        loc="upper center",
        bbox_to_anchor=(0.5, -0.01),
        ncols=3,
        frameon=False,
        fontsize=8.5,
        labelcolor=INK,
        scatterpoints=1,
        markerscale=1.4,
        handletextpad=0.3,
        columnspacing=1.2,
    )


def view_from_above(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3, 4) poses -> (2, 3) axes of the ground plane, x along the widest spread of cameras.

    Up is the mean of the images' up. Where cameras mostly look one way, and move less along it
    than along that up, they look down, and up is the opposite of their view.
    """
    centres = centre(poses)
    spread = centres - centres.mean(axis=0)
    up, back = -poses[:, 1, :3].mean(axis=0), -poses[:, 2, :3].mean(axis=0)
    if np.linalg.norm(back) > 0.7 and np.linalg.norm(spread @ back) < np.linalg.norm(spread @ up):
        up = back
    up = up / (np.linalg.norm(up) or 1.0)
    spread = spread - np.outer(spread @ up, up)
    # Without any spread the first right-singular vector is arbitrary, so take it off `up` again.
    across = np.linalg.svd(spread, full_matrices=False)[2][0]
    across = across - (across @ up) * up
    if np.linalg.norm(across) < 1e-9:
        across = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    across = across / np.linalg.norm(across)
    return np.stack([across, np.cross(up, across)])
