"""All pictures that Protomark draws, by matplotlib."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from protomark.extras import optional
from protomark.geometry.pose import camera_centers, ground_plane

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, MUTED, GRID, OURS = "#1f2430", "#6b7280", "#e5e7eb", "#0f766e"
RED, AMBER = "#dc2626", "#b45309"
SERIES = (OURS, "#0369a1", "#4d7c0f", AMBER, "#7c3aed", "#be123c", "#9ca3af")
_LANDMARK = "#c3c9d3"
# Share of landmarks beyond each side of a picture, as reconstructions have stray points.
_STRAY = 0.03
_MAX_LANDMARKS = 20_000
_MAX_OBSERVATIONS = 20


def new_figure(width: float, height: float, **padding: float) -> Figure:
    """A figure of this size in inches, without a window, in a constrained layout."""
    engine = optional("matplotlib.layout_engine").ConstrainedLayoutEngine(**padding)
    figure: Figure = optional("matplotlib.figure").Figure(figsize=(width, height), layout=engine)
    return figure


def style_axes(axes: Axes, x: str, y: str, title: str = "") -> None:
    """Give axes the labels, grid and frame of all plots."""
    axes.set_xlabel(x, color=INK)
    axes.set_ylabel(y, color=INK)
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=MUTED, length=0)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(GRID)
    add_title(axes, title)


def add_title(axes: Axes, title: str) -> None:
    """Write a title above the left end of axes."""
    if title:
        axes.set_title(title, loc="left", color=INK, fontsize=11, fontweight="bold")


def check_suffix(path: str | os.PathLike[str]) -> None:
    """Raise ValueError unless the path ends in .png, .svg or .pdf."""
    if Path(path).suffix.lower() not in (".png", ".svg", ".pdf"):
        raise ValueError(f"{path}: name a picture that ends in .png, .svg or .pdf")


def save_figure(
    figure: Figure, path: str | os.PathLike[str], made_by: str = "protomark", dpi: int = 160
) -> None:
    """Write a figure as PNG, SVG or PDF atomically, with its origin in the file's metadata."""
    path = Path(path)
    check_suffix(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        key = "Software" if path.suffix.lower() == ".png" else "Creator"
        figure.savefig(temporary, dpi=dpi, facecolor="white", metadata={key: made_by})
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def svg_text(figure: Figure) -> str:
    """The figure as an SVG element for an HTML page, the same for equal figures."""
    text = io.StringIO()
    with optional("matplotlib").rc_context({"svg.hashsalt": "protomark", "svg.fonttype": "none"}):
        figure.savefig(text, format="svg", metadata={"Date": None})
    svg = text.getvalue()
    return svg[svg.index("<svg") :]


@dataclass(frozen=True)
class Curve:
    """Values of one method at several sizes, drawn as a line."""

    label: str  # text beside the line
    x: Sequence[float]  # (n,) sizes, ascending
    y: Sequence[float]  # (n,) values
    spread: Sequence[float]  # (n,) standard deviations, 0 where unknown
    colour: str = MUTED  # colour of the line
    ours: bool = False  # whether the method is Protomark's, which stands out


def draw_curves(axes: Axes, curves: Sequence[Curve], x: str, y: str, title: str = "") -> None:
    """Draw curves over sizes on a log scale, with labels beside their last points."""
    for curve in curves:
        axes.errorbar(
            curve.x,
            curve.y,
            yerr=curve.spread,
            color=curve.colour,
            marker="o",
            markersize=7 if curve.ours else 5,
            linewidth=2 if curve.ours else 1.2,
            elinewidth=1,
            zorder=3 if curve.ours else 2,
        )
    _label_curves(axes, curves)
    axes.set_xscale("log", base=2)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    style_axes(axes, x, y, title)


def _label_curves(axes: Axes, curves: Sequence[Curve]) -> None:
    """Label our curves left of their last points, others right of them, without overlap."""
    bottom, top = axes.get_ylim()
    room = 0.045 * (top - bottom)
    placed: list[tuple[float, float]] = []
    for curve in sorted(curves, key=lambda c: -c.y[-1]):
        x, y = curve.x[-1], curve.y[-1]
        if curve.ours:
            axes.annotate(
                curve.label,
                (x, y),
                xytext=(-8, 4),
                textcoords="offset points",
                color=curve.colour,
                fontsize=10,
                fontweight="bold",
                ha="right",
            )
            continue
        for other_x, other_y in placed:
            if y > other_y - room and 0.3 < x / other_x < 3:
                y = other_y - room
        placed.append((x, y))
        axes.annotate(curve.label, (1.13 * x, y), color=curve.colour, fontsize=9, va="center")


@dataclass(frozen=True)
class ScenePicture:
    """The data of a map from above, with frames that were localized in it."""

    landmarks: NDArray[np.float64]  # (l, 3) positions of the landmarks
    matched: NDArray[np.float64]  # (n, 3) positions of the landmarks that support a query's pose
    support: NDArray[np.float64]  # (s, 3, 4) poses of the keyframes that built the map
    true: NDArray[np.float64]  # (q, 3, 4) true poses of the query keyframes
    # (3, 4) pose of each query keyframe, None if none was found.
    estimated: list[NDArray[np.float64] | None]


def draw_scene(axes: Axes, picture: ScenePicture, title: str = "") -> None:
    """Draw landmarks, matched landmarks, and true and estimated query poses from above."""
    plane = ground_plane(np.concatenate([picture.support, picture.true]))
    origin = np.median(picture.landmarks, axis=0)

    def flat(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((points - origin) @ plane.T)

    def dots(points: NDArray[np.float64], **style: Any) -> None:
        axes.scatter(*flat(points).T, **style)

    def viewing_directions(poses: NDArray[np.float64], length: float, **style: Any) -> None:
        starts = flat(camera_centers(poses))
        ends = starts + length * (poses[:, 2, :3] @ plane.T)
        for (x0, y0), (x1, y1) in zip(starts, ends, strict=True):
            axes.plot([x0, x1], [y0, y1], **style)

    landmarks, queries = flat(picture.landmarks), flat(camera_centers(picture.true))
    low = np.minimum(np.quantile(landmarks, _STRAY, axis=0), queries.min(axis=0))
    high = np.maximum(np.quantile(landmarks, 1 - _STRAY, axis=0), queries.max(axis=0))
    size = float((high - low).max())
    found = np.array([pose for pose in picture.estimated if pose is not None]).reshape(-1, 3, 4)

    dots(picture.landmarks, s=4, color=_LANDMARK, linewidths=0, label="landmark")
    dots(picture.matched, s=5, color=OURS, linewidths=0, label="landmark matched by a query")
    cameras = camera_centers(picture.support)
    dots(cameras, s=12, color=MUTED, marker="^", linewidths=0, label="support keyframe")
    viewing_directions(picture.true, 0.08 * size, color=RED, linewidth=1.2, zorder=3)
    ring = {"facecolors": "none", "edgecolors": RED, "linewidths": 1.4}
    dots(camera_centers(picture.true), s=80, zorder=4, label="query, true pose", **ring)
    viewing_directions(found, 0.055 * size, color=INK, linewidth=2.4, zorder=5)
    label = "query, estimated pose"
    dots(camera_centers(found), s=18, color=INK, linewidths=0, zorder=6, label=label)
    _frame_picture(axes, (low + high) / 2, 0.56 * size, 0.56 * size)
    add_title(axes, title)
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


def _frame_picture(
    axes: Axes, middle: NDArray[np.float64], half_width: float, half_height: float
) -> None:
    axes.set_xlim(middle[0] - half_width, middle[0] + half_width)
    axes.set_ylim(middle[1] - half_height, middle[1] + half_height)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_color(GRID)


def merge_figure(landmarks: Sequence[NDArray[np.float64]], common: NDArray[np.float64]) -> Figure:
    """Maps in one world, positions (l, 3) each, and where they were recognized, (c, 3)."""
    figure = new_figure(8, 6)
    axes = figure.add_subplot()
    every = [points[np.isfinite(points).all(axis=1)] for points in landmarks]
    together = np.concatenate([*every, common])
    together = together[:: 1 + len(together) // _MAX_LANDMARKS]
    middle = np.median(together, axis=0)
    # The plane of the widest spread, whatever few stray points do.
    near = np.linalg.norm(together - middle, axis=1)
    near = together[near <= np.quantile(near, 1 - _STRAY)] - middle
    plane = np.linalg.svd(near, full_matrices=False)[2][:2]

    def dots(points: NDArray[np.float64], **style: Any) -> None:
        axes.scatter(*((points - middle) @ plane.T).T, **style)

    for i, points in enumerate(every, 1):
        points = points[:: 1 + len(points) // _MAX_LANDMARKS]
        colour = SERIES[(i - 1) % len(SERIES)]
        dots(points, s=3, color=colour, linewidths=0, alpha=0.6, label=f"map {i}")
    dots(common, s=5, color=RED, linewidths=0, label="in both")
    half = 1.1 * np.abs(near @ plane.T).max(axis=0)
    _frame_picture(axes, np.zeros(2), float(half[0]), float(half[1]))
    add_title(axes, "Maps in the world of the first, and the landmarks that join them")
    axes.legend(frameon=False, fontsize=9, labelcolor=INK, markerscale=3)
    return figure


@dataclass(frozen=True)
class MapPictures:
    """The data of the pictures in a map's report."""

    positions: NDArray[np.float64]  # (l, 3) positions of the landmarks
    counts: NDArray[np.int64]  # (l,) int64, observations per landmark
    poses: NDArray[np.float64]  # (f, 3, 4) poses of the frames, along the camera's path
    errors: NDArray[np.float64]  # (o,) reprojection errors, pixels
    track_lengths: Mapping[str, int]  # number of landmarks by number of observations
    # For each frame of the input `registered`, `inliers`, bytes, and seconds by stage.
    frames: Sequence[Mapping[str, Any]] = field(default_factory=list)
    stages: Sequence[str] = ()  # names of the stages


def map_figures(pictures: MapPictures) -> list[Figure]:
    """The map from above, its memory and matches over time, and its quality."""
    return [_map_from_above(pictures), _map_growth(pictures), _map_quality(pictures)]


def _map_from_above(pictures: MapPictures) -> Figure:
    figure = new_figure(11, 5.5)
    axes = figure.add_subplot()
    add_title(axes, "From above: landmarks by observations, and the path of the camera")
    if not len(pictures.poses):
        return figure
    plane = ground_plane(pictures.poses)
    path = camera_centers(pictures.poses) @ plane.T
    step = max(1, len(pictures.positions) // _MAX_LANDMARKS)
    points = pictures.positions[::step] @ plane.T
    if len(points):
        x, y = points.T
        shown = axes.scatter(
            x,
            y,
            s=2,
            c=np.minimum(pictures.counts[::step], _MAX_OBSERVATIONS),
            cmap="viridis",
            linewidths=0,
            rasterized=True,
        )
        figure.colorbar(shown, ax=axes, label=f"observations (yellow: {_MAX_OBSERVATIONS} or more)")
        low = np.minimum(np.quantile(points, _STRAY, axis=0), path.min(0))
        high = np.maximum(np.quantile(points, 1 - _STRAY, axis=0), path.max(0))
        half = 0.55 * float((high - low).max()) or 1.0
        _frame_picture(axes, (low + high) / 2, 1.6 * half, half)
    axes.plot(*path.T, color=RED, linewidth=1)
    return figure


def _map_growth(pictures: MapPictures) -> Figure:
    figure = new_figure(11, 3.8)
    left, right = figure.subplots(1, 2)
    x = np.arange(len(pictures.frames))
    for name, colour, label in (
        ("memory_bytes", OURS, "map"),
        ("descriptor_bytes", MUTED, "all descriptors of the same observations"),
        ("window_bytes", AMBER, "descriptors in the window"),
    ):
        values = np.array([frame[name] for frame in pictures.frames]) / 1e6
        left.plot(x, values, color=colour, label=label, linewidth=1.6)
    left.legend(frameon=False, fontsize=9, labelcolor=INK)
    style_axes(left, "frame", "MB", "Descriptor memory")
    lost = [i for i, frame in enumerate(pictures.frames) if not frame["registered"]]
    right.plot(x, [frame["inliers"] for frame in pictures.frames], color=OURS, linewidth=1)
    right.plot(lost, np.zeros(len(lost)), "x", color=RED, label="no pose")
    if lost:
        right.legend(frameon=False, fontsize=9, labelcolor=INK)
    style_axes(right, "frame", "matches that agree with the pose", "Matches with the map")
    return figure


def _map_quality(pictures: MapPictures) -> Figure:
    figure = new_figure(11, 3.8)
    left, middle, right = figure.subplots(1, 3)
    left.bar(list(pictures.track_lengths), list(pictures.track_lengths.values()), color=OURS)
    left.tick_params(axis="x", labelrotation=60)
    style_axes(left, "observations", "landmarks", "Track lengths")
    errors = pictures.errors
    if len(errors):
        middle.hist(errors, bins=40, range=(0, np.quantile(errors, 0.995)), color=OURS)
    style_axes(middle, "pixels", "observations", "Reprojection error")
    base = np.zeros(len(pictures.frames))
    for stage, colour in zip(pictures.stages, SERIES, strict=False):
        values = np.array([1e3 * f["seconds"].get(stage, 0.0) for f in pictures.frames])
        x = np.arange(len(values))
        right.fill_between(x, base, base + values, color=colour, label=stage, linewidth=0)
        base = base + values
    if len(base):
        right.set_ylim(0, 1.5 * float(np.quantile(base, 0.95)) + 1)
    right.legend(frameon=False, fontsize=8, labelcolor=INK, ncols=2)
    style_axes(right, "frame", "milliseconds", "Time per frame")
    return figure


def training_figure(
    steps: Sequence[int],  # (v,) steps at which validation ran
    losses: Sequence[float],  # (v,) mean training losses
    precision: Mapping[int, Sequence[float]],  # (v,) precisions by number of dimensions
    # First of the steps with quantisation in the loop, None if there is none.
    quantized_from: int | None,
    title: str = "",
) -> Figure:
    """Training loss, and validation precision by dimension, over the steps of a training."""
    figure = new_figure(8, 3.4)
    left, right = figure.subplots(1, 2)
    left.plot(steps, losses, color=INK, marker="o", markersize=3)
    for i, (dim, values) in enumerate(precision.items(), 1):
        shade = 0.25 + 0.75 * i / len(precision)
        colour = (0.06, 0.46, 0.43, shade)
        right.plot(steps, values, color=colour, marker="o", markersize=3, label=str(dim))
    style_axes(left, "step", "training loss")
    style_axes(right, "step", "precision on validation")
    right.legend(title="dimensions", fontsize="small", title_fontsize="small")
    if quantized_from is not None:
        for axes in (left, right):
            axes.axvspan(quantized_from, steps[-1], color=GRID, alpha=0.5, linewidth=0)
    figure.suptitle(f"{title} (grey: quantisation in the loop)" if title else "")
    return figure
