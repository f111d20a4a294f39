"""The course of a training, for the eye: loss and validation precision by step."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from protomark.files import replacing

if TYPE_CHECKING:
    from protomark.training.train import Progress

_BLOCKS = "▁▂▃▄▅▆▇█"


def sparkline(values: Sequence[float], width: int = 20) -> str:
    """`values` as up to `width` block characters, the least lowest; evenly drawn if there are more.

    >>> sparkline([0.0, 1.0, 2.0])
    '▁▅█'
    """
    if not values:
        return ""
    n = min(len(values), width)
    drawn = [values[(i * (len(values) - 1)) // max(n - 1, 1)] for i in range(n)]
    low, high = min(drawn), max(drawn)
    top = len(_BLOCKS) - 1
    return "".join(
        _BLOCKS[int((v - low) / (high - low) * top + 0.5) if high > low else 0] for v in drawn
    )


def save_curve(history: Sequence[Progress], path: Path, title: str = "") -> None:
    """Draw the loss and the precision of every dimension over the steps (.png or .svg).

    Raises:
        ValueError: `history` is empty, or the ending is not one that matplotlib can write.
    """
    if not history:
        raise ValueError("nothing to draw: no validation has run yet")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.4), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    steps = [p.step for p in history]
    left.plot(steps, [p.loss for p in history], color="#1f2430", marker="o", markersize=3)
    left.set_ylabel("training loss")
    dims = list(history[-1].precision)
    for i, d in enumerate(dims):
        shade = 0.25 + 0.75 * (i + 1) / len(dims)
        right.plot(
            steps,
            [p.precision[d] for p in history],
            color=(0.06, 0.46, 0.43, shade),
            marker="o",
            markersize=3,
            label=str(d),
        )
    right.set_ylabel("precision on validation")
    right.legend(title="dimensions", fontsize="small", title_fontsize="small")
    first = next((p.step for p in history if p.quantized), None)
    for axes in (left, right):
        axes.set_xlabel("step")
        axes.grid(color="#e5e7eb")
        axes.spines[["top", "right"]].set_visible(False)
        if first is not None:
            axes.axvspan(first, steps[-1], color="#e5e7eb", alpha=0.5, linewidth=0)
    figure.suptitle(f"{title} (grey: quantisation in the loop)" if title else "")
    with replacing(path) as file:
        figure.savefig(file, format=path.suffix.lstrip("."), dpi=120)
