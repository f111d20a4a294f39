"""The paper's two figures, drawn from our numbers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from protomark.evaluation.plot import INK, MUTED, save_figure, style_axes
from protomark.reproduce.paper import PRECISION_BY_DIM, TABLE
from protomark.reproduce.results import Curve, Results
from protomark.reproduce.training import LAYERS, OBJECTIVES, SHAPES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ENDINGS = ("svg", "png")
_COLOURS = {"triplet": "#b45309", "prototypical": "#0f766e"}
_STYLES = {"funnel": ("-", "o"), "fat": ("--", "s")}


def draw_depth(results: Results) -> Figure:
    """Precision on validation against depth, for both shapes and both objectives."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.4), layout="constrained")
    axes = figure.add_subplot()
    for objective in OBJECTIVES:
        for shape in SHAPES:
            line, marker = _STYLES[shape]
            axes.plot(
                LAYERS,
                [results.point(objective, shape, n).precision for n in LAYERS],
                line,
                marker=marker,
                color=_COLOURS[objective],
                label=f"{shape}, {objective}",
                markersize=6,
                markerfacecolor="white" if shape == "fat" else None,
                linewidth=1.8,
            )
    axes.set_xticks(LAYERS)
    style_axes(axes, "layers", f"precision on {', '.join(results.names('validation'))}")
    axes.set_title("Precision against depth, 16 outputs", **_TITLE)
    axes.legend(frameon=False, labelcolor=INK, fontsize=9)
    return figure


def draw_dimension(results: Results) -> Figure:
    """Precision on test against dimension, as it is and as a share of the unaggregated one."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4.2), layout="constrained")
    whole = results.curves_unaggregated
    plain, share = figure.subplots(1, 2)
    for axes, ours, theirs in ((plain, 1.0, 1.0), (share, whole, TABLE["unaggregated"])):
        for i, curve in enumerate(results.curves):
            _line(axes, curve, ours, hollow=i > 0)
        axes.plot(
            list(PRECISION_BY_DIM),
            [value / theirs for value in PRECISION_BY_DIM.values()],
            ":",
            marker="D",
            markersize=5,
            color=MUTED,
            label="the paper's figures",
        )
        axes.set_xscale("log", base=2)
        axes.set_xticks(list(PRECISION_BY_DIM), [str(dim) for dim in PRECISION_BY_DIM])
        axes.minorticks_off()
    plain.axhline(whole, color=INK, linewidth=1, label="unaggregated, ours")
    plain.axhline(
        TABLE["unaggregated"], color=MUTED, linewidth=1, ls=":", label="unaggregated, the paper's"
    )
    share.axhline(1, color=INK, linewidth=1)
    style_axes(plain, "dimensions of a prototype", "precision, mean of test sequences")
    style_axes(share, "dimensions of a prototype", "share of the unaggregated precision")
    plain.set_title("Precision against dimension", **_TITLE)
    plain.legend(frameon=False, labelcolor=INK, fontsize=8.5, loc="lower right")
    return figure


def save(results: Results, folder: Path) -> None:
    """Write depth and dimension as SVG and PNG."""
    for name, draw in (("depth", draw_depth), ("dimension", draw_dimension)):
        figure = draw(results)
        for ending in ENDINGS:
            save_figure(figure, folder / f"{name}.{ending}", made_by="protomark reproduce")


_TITLE: dict[str, Any] = {"loc": "left", "color": INK, "fontsize": 11, "fontweight": "bold"}


def _line(axes: Axes, curve: Curve, by: float, hollow: bool) -> None:
    axes.plot(
        list(curve.precision),
        [curve.mean(dim) / by for dim in curve.precision],
        marker="o",
        markersize=6,
        markerfacecolor="white" if hollow else None,
        linewidth=2,
        color=_COLOURS[curve.training.objective],
        label=f"ours: {curve.training.label}",
    )
