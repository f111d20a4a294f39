"""Trajectories from above, memory over time, and prototypes beside all descriptors."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from protomark.evaluation.mapping.results import Results, SequenceResult
from protomark.evaluation.mapping.targets import matching
from protomark.evaluation.mapping.variants import COLMAP, LABELS, PROTOTYPES, TRADITIONAL
from protomark.evaluation.plot import GRID, INK, MUTED, OURS, save_figure, style_axes
from protomark.evaluation.scene_plot import view_from_above
from protomark.evaluation.trajectory import trajectory_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NAMES = ("trajectories.svg", "memory.svg", "ratios.svg")
_COLOURS = {
    TRADITIONAL: "#b45309",
    "medoid": "#7c3aed",
    PROTOTYPES: OURS,
    "prototypes-16": "#0369a1",
    COLMAP: "#be123c",
}
_COLUMNS = 3
_TITLE: dict[str, Any] = {"loc": "left", "color": INK, "fontsize": 11, "fontweight": "bold"}


def save(results: Results, folder: Path) -> None:
    """Write all figures as SVG."""
    import matplotlib

    draws = (draw_trajectories, draw_memory, draw_ratios)
    with matplotlib.rc_context({"svg.hashsalt": "protomark", "svg.fonttype": "none"}):
        for name, draw in zip(NAMES, draws, strict=True):
            save_figure(draw(results), folder / name, made_by="protomark evaluate-mapping")


def _grid(count: int, height: float) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure

    columns = min(count, _COLUMNS)
    rows = -(-count // columns)
    # Wide enough for the legend.
    figure = Figure(figsize=(max(3.9 * columns, 8), height * rows), layout="constrained")
    return figure, [figure.add_subplot(rows, columns, i + 1) for i in range(count)]


def _legend(figure: Figure, axes: list[Axes]) -> None:
    handles: dict[str, Any] = {}
    for one in axes:
        for handle, label in zip(*one.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(
        list(handles.values()),
        list(handles),
        loc="outside lower center",
        ncols=max(len(handles), 1),
        frameon=False,
        labelcolor=INK,
        fontsize=9,
    )


def draw_trajectories(results: Results) -> Figure:
    """Camera centres of all variants, aligned, on the true ones, from above."""
    figure, axes = _grid(len(results.sequences), 3.4)
    for one, s in zip(axes, results.sequences, strict=True):
        _trajectory(one, s)
    _legend(figure, axes)
    return figure


def _trajectory(axes: Axes, s: SequenceResult) -> None:
    true = s.true
    plane = view_from_above(np.array(list(s.poses.values())))
    middle = np.array(list(true.values())).mean(axis=0)

    def flat(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((points - middle) @ plane.T)

    way = flat(np.array(list(true.values())))
    axes.plot(*way.T, color="#c3c9d3", linewidth=5, label="true", solid_capstyle="round")
    low, high = way.min(axis=0), way.max(axis=0)
    for variant, run in s.runs.items():
        names = [n for n in true if n in run.centers]
        try:
            estimated = np.array([run.centers[n] for n in names])
            found = trajectory_error(estimated, np.array([true[n] for n in names]))
        except ValueError:
            continue
        places = flat(found.alignment(estimated))
        ours = variant == PROTOTYPES
        axes.plot(
            *places.T,
            color=_COLOURS.get(variant, MUTED),
            linewidth=1.8 if ours else 1,
            linestyle="--" if variant == COLMAP else "-",
            label=LABELS.get(variant, variant),
            zorder=3 if ours else 2,
        )
    middle_flat, half = (low + high) / 2, 0.62 * float((high - low).max()) or 1.0
    axes.set_xlim(middle_flat[0] - half, middle_flat[0] + half)
    axes.set_ylim(middle_flat[1] - half, middle_flat[1] + half)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_color(GRID)
    axes.set_title(f"{s.name}, {s.frames} frames", **_TITLE)


def draw_memory(results: Results) -> Figure:
    """Bytes of each map after each frame, without the window."""
    figure, axes = _grid(len(results.sequences), 2.6)
    for one, s in zip(axes, results.sequences, strict=True):
        for variant, run in s.runs.items():
            if run.growth:
                one.plot(
                    np.array(run.growth) / 1e6,
                    color=_COLOURS.get(variant, MUTED),
                    linewidth=1.8 if variant == PROTOTYPES else 1.3,
                    label=LABELS.get(variant, variant),
                )
        one.set_ylim(bottom=0)
        style_axes(one, "frame", "MB")
        one.set_title(s.name, **_TITLE)
    _legend(figure, axes)
    return figure


def draw_ratios(results: Results) -> Figure:
    """Every variant as a share of all descriptors: frames, error, memory, matching."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5.6), layout="constrained")
    axes = list(figure.subplots(2, 2).ravel())
    heads = ("registered frames", "trajectory error", "descriptor memory", "matching time")
    used = [s for s in results.sequences if TRADITIONAL in s.runs]
    variants = list(dict.fromkeys(v for s in used for v in s.runs))
    width = 0.8 / max(len(variants), 1)
    for which, (one, head) in enumerate(zip(axes, heads, strict=True)):
        for i, variant in enumerate(variants):
            values = [_share(s, variant, which) for s in used]
            places = np.arange(len(used)) + (i - (len(variants) - 1) / 2) * width
            one.bar(
                places,
                values,
                width,
                color=_COLOURS.get(variant, MUTED),
                label=LABELS.get(variant, variant),
            )
        one.axhline(1, color=INK, linewidth=0.8)
        style_axes(one, "", "")
        one.set_xticks(range(len(used)), [s.name for s in used])
        if which == 1:
            one.set_ylim(0, 3)
        one.set_title(f"{head}, all descriptors = 1", **_TITLE)
    _legend(figure, axes)
    return figure


def _share(s: SequenceResult, variant: str, which: int) -> float:
    run, other = s.runs.get(variant), s.runs[TRADITIONAL]
    if run is None:
        return float("nan")
    if which == 0:
        return run.registered / other.registered if other.registered else float("nan")
    if which == 1:
        ours, theirs = s.error(variant, TRADITIONAL), s.error(TRADITIONAL, variant)
        return ours / theirs if ours is not None and theirs else float("nan")
    if which == 2:
        if run.memory_bytes is None or not other.memory_bytes:
            return float("nan")
        return run.memory_bytes / other.memory_bytes
    if variant == COLMAP or not matching(other.seconds):
        return float("nan")
    return matching(run.seconds) / matching(other.seconds)
