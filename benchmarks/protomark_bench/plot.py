"""Draws panels of lines and bars in one style."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from protomark.files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, MUTED, GRID = "#1f2430", "#6b7280", "#e5e7eb"
TEAL, AMBER, VIOLET, BLUE, RED = "#0f766e", "#b45309", "#7c3aed", "#0369a1", "#be123c"


@dataclass(frozen=True)
class Series:
    """One line, or one bar per tick of the x axis.

    Attributes:
        label: name in the legend; empty for none.
        x, y: values; bars take the y values in the order of the panel's `ticks`.
        color: color of line and markers.
        style: line style and marker of Matplotlib, such as "-o", ":D" or "--".
        width: width of the line.
        hollow: whether markers are white inside.
    """

    label: str
    x: Sequence[float]
    y: Sequence[float]
    color: str = TEAL
    style: str = "-o"
    width: float = 1.8
    hollow: bool = False


@dataclass(frozen=True)
class Panel:
    """One plot of a figure.

    Attributes:
        title, x, y: texts.
        series: lines or bars.
        ticks: names of values on the x axis, which bars need.
        log: axes with a logarithmic scale: "x", "y" and "2" (x to base 2).
        levels: horizontal lines, (height, label, color).
        bottom, top: limits of the y axis.
        square: whether both axes have the same scale and no ticks.
    """

    title: str
    x: str
    y: str
    series: Sequence[Series]
    ticks: dict[float, str] = field(default_factory=dict)
    log: str = ""
    levels: Sequence[tuple[float, str, str]] = ()
    bottom: float | None = None
    top: float | None = None
    square: bool = False


def draw_lines(panels: Sequence[Panel], columns: int = 3, height: float = 4.2) -> Figure:
    """Draw panels of lines side by side, with one legend for all of them."""
    figure, axes = _grid(len(panels), columns, height)
    for panel, one in zip(panels, axes, strict=True):
        for s in panel.series:
            one.plot(
                s.x,
                s.y,
                s.style,
                color=s.color,
                label=s.label or None,
                linewidth=s.width,
                markersize=5,
                markerfacecolor="white" if s.hollow else None,
            )
        _finish(one, panel)
    _legend(figure, axes)
    return figure


def draw_bars(panels: Sequence[Panel], columns: int = 2, height: float = 2.8) -> Figure:
    """Draw panels of bars in groups, one group per tick."""
    figure, axes = _grid(len(panels), columns, height)
    for panel, one in zip(panels, axes, strict=True):
        width = 0.8 / max(len(panel.series), 1)
        for i, s in enumerate(panel.series):
            offset = (i - (len(panel.series) - 1) / 2) * width
            positions = [tick + offset for tick in range(len(panel.ticks))]
            one.bar(positions, list(s.y), width, color=s.color, label=s.label)
        _finish(one, panel)
    _legend(figure, axes)
    return figure


def draw_ratios(
    rows: Sequence[tuple[str, tuple[float, float, float]]], title: str, x: str
) -> Figure:
    """Draw a bar per row from 1 to its median ratio, on a log scale, with its spread as a line.

    Args:
        rows: labels with the median, least and greatest ratio.
        title: title of the plot.
        x: label of the x axis.
    """
    figure, (axes,) = _grid(1, 1, 1 + 0.24 * len(rows))
    for i, (_, (median, low, high)) in enumerate(rows):
        color = TEAL if median >= 1 else MUTED
        axes.barh(i, median - 1, left=1, height=0.62, color=color)
        axes.hlines(i, low, high, color=INK, linewidth=1)
        at = (max(median, high), i)
        axes.annotate(f" {median:.1f}", at, va="center", color=INK, fontsize=7)
    axes.set_xscale("log")
    axes.axvline(1, color=INK, linewidth=1)
    _finish(axes, Panel(title, x, "", ()))
    axes.set_yticks(range(len(rows)), [label for label, _ in rows], fontsize=7)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")
    return figure


def save_svg(figure: Figure, path: Path, made_by: str) -> None:
    """Write a figure as SVG atomically; the same figure yields the same bytes."""
    import matplotlib

    options: Any = {"svg.hashsalt": "protomark", "svg.fonttype": "none"}
    with matplotlib.rc_context(options), replacing(path) as file:
        metadata = {"Creator": made_by, "Date": None}
        figure.savefig(file, format="svg", facecolor="white", metadata=metadata)


def _grid(count: int, columns: int, height: float) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure

    columns = min(count, columns)
    rows = -(-count // columns)
    width = {1: 9.0, 2: 9.0}.get(columns, 3.9 * columns)
    figure = Figure(figsize=(width, height * rows), layout="constrained")
    return figure, [figure.add_subplot(rows, columns, i + 1) for i in range(count)]


def _finish(axes: Axes, panel: Panel) -> None:
    """Apply a panel's texts, scales and limits to its axes."""
    axes.set_title(panel.title, loc="left", color=INK, fontsize=11, fontweight="bold")
    axes.set_xlabel(panel.x, color=INK)
    axes.set_ylabel(panel.y, color=INK)
    axes.tick_params(colors=MUTED, length=0)
    axes.set_axisbelow(True)
    for side, spine in axes.spines.items():
        spine.set_color(GRID)
        spine.set_visible(panel.square or side in ("left", "bottom"))
    for height, label, color in panel.levels:
        axes.axhline(height, color=color, linewidth=1, label=label or None)
    if "x" in panel.log or "2" in panel.log:
        axes.set_xscale("log", base=2 if "2" in panel.log else 10)
    if "y" in panel.log:
        axes.set_yscale("log")
    if panel.ticks:
        axes.set_xticks(list(panel.ticks), list(panel.ticks.values()))
        axes.minorticks_off()
    if panel.bottom is not None or panel.top is not None:
        axes.set_ylim(panel.bottom, panel.top)
    if panel.square:
        axes.set_aspect("equal")
        axes.set_xticks([])
        axes.set_yticks([])
    else:
        axes.grid(color=GRID, linewidth=0.8)


def _legend(figure: Figure, axes: Sequence[Axes]) -> None:
    """One legend below the figure, each label once."""
    handles: dict[str, Any] = {}
    for one in axes:
        for handle, label in zip(*one.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if handles:
        # Number of labels of this length that fit into a row.
        columns = int(13 * figure.get_figwidth() / (6 + max(map(len, handles))))
        figure.legend(
            list(handles.values()),
            list(handles),
            loc="outside lower center",
            ncols=min(len(handles), max(columns, 1)),
            frameon=False,
            labelcolor=INK,
            fontsize=9,
        )
