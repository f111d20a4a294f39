"""Precision against bytes per landmark."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from protomark.evaluation.results import Summary

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, MUTED, GRID, OURS = "#1f2430", "#6b7280", "#e5e7eb", "#0f766e"
# Families that are lines of several sizes get a colour of their own, single methods are grey.
_COLOURS = {"pca": "#b45309", "discriminant": "#7c3aed"}
_OURS_COLOURS = (OURS, "#0369a1", "#4d7c0f", "#be123c")
_SHORT = {
    "unaggregated": "all descriptors",
    "random": "random",
    "first": "first seen",
    "majority": "quantised mean",
    "and": "bitwise AND",
    "medoid": "medoid",
    "mean": "mean of bits",
    "pca": "PCA",
    "discriminant": "discriminant",
    "protomark": "Protomark",
    "protomark-4bit": "Protomark x4",
    "protomark-looks": "Protomark looks",
}


def draw_precision(axes: Axes, rows: Sequence[Summary], title: str = "") -> None:
    """Draw precision over bytes, log scale; methods of one family are joined by a line."""
    families: dict[str, list[Summary]] = {}
    for row in rows:
        families.setdefault(row.family, []).append(row)
    ours = [family for family in families if family.startswith("protomark")]
    labels = []
    for family, same in families.items():
        same = sorted(same, key=lambda row: row.bytes_per_landmark)
        own = family in ours
        colour = (
            _OURS_COLOURS[ours.index(family) % len(_OURS_COLOURS)]
            if own
            else _COLOURS.get(family.removesuffix("-float"), MUTED)
        )
        x = [row.bytes_per_landmark for row in same]
        y = [row.precision for row in same]
        axes.errorbar(
            x,
            y,
            yerr=[row.spread or 0 for row in same],
            color=colour,
            marker="o",
            markersize=7 if own else 5,
            linewidth=2 if own else 1.2,
            elinewidth=1,
            zorder=3 if own else 2,
        )
        kind, _, encoder = family.partition("@")
        short = f"{_SHORT.get(kind, kind)} {encoder}".rstrip()
        labels.append((x[-1], y[-1], short, colour, own))
    _place(axes, labels)
    axes.set_xscale("log", base=2)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    axes.set_title(title, loc="left", color=INK, fontsize=11, fontweight="bold")
    style_axes(axes, "bytes per landmark (log)", "precision")


def style_axes(axes: Axes, x: str, y: str) -> None:
    """Labels, grid and frame as all plots have them."""
    axes.set_xlabel(x, color=INK)
    axes.set_ylabel(y, color=INK)
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=MUTED, length=0)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(GRID)


def save_plot(rows: Sequence[Summary], path: str | os.PathLike[str], title: str = "") -> None:
    """Write the plot as PNG, SVG or PDF, by the ending of `path`.

    Raises:
        ValueError: the ending is another one.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    draw_precision(figure.add_subplot(), rows, title)
    save_figure(figure, path)


def save_figure(
    figure: Figure, path: str | os.PathLike[str], made_by: str = "protomark evaluate"
) -> None:
    """Write a figure beside the target, then rename it over the target.

    Args:
        figure: the figure.
        path: PNG, SVG or PDF, by its ending.
        made_by: what the file says of its origin.
    """
    path = Path(path)
    check_ending(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        key = "Software" if path.suffix.lower() == ".png" else "Creator"
        figure.savefig(temporary, dpi=160, facecolor="white", metadata={key: made_by})
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def check_ending(path: str | os.PathLike[str]) -> None:
    """Raise ValueError if the path does not end in .png, .svg or .pdf."""
    if Path(path).suffix.lower() not in (".png", ".svg", ".pdf"):
        raise ValueError(f"{path}: a picture's name must end in .png, .svg or .pdf")


def _place(axes: Axes, labels: list[tuple[float, float, str, str, bool]]) -> None:
    """Name each family beside its last point: ours to the left, others to the right of it.

    Of names on the right that would overlap, one is lowered.
    """
    bottom, top = axes.get_ylim()
    room = 0.045 * (top - bottom)
    placed: list[tuple[float, float]] = []
    for x, y, text, colour, own in sorted(labels, key=lambda label: -label[1]):
        if own:
            axes.annotate(
                text,
                (x, y),
                xytext=(-8, 4),
                textcoords="offset points",
                color=colour,
                fontsize=10,
                fontweight="bold",
                ha="right",
            )
            continue
        height = y
        for at, other in placed:
            if height > other - room and 0.3 < x / at < 3:
                height = other - room
        placed.append((x, height))
        axes.annotate(text, (1.13 * x, height), color=colour, fontsize=9, va="center")
