"""The plots of a bench: ratios to the peers, and growth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from protomark.bench.results import Contest, Results, Timing
from protomark.evaluation.plot import INK, MUTED, OURS, save_figure, style_axes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ENDINGS = ("svg", "png")
RECALL = 0.99  # of the approximate searches whose ratios are drawn
_COLOURS = {"exact": OURS, "approximate": "#b45309"}


def save(results: Results, folder: Path) -> list[str]:
    """Write what there is to draw; the names of the SVG files."""
    drawn = {"ratios": draw_ratios(results), "growth": draw_growth(results)}
    names = []
    for name, figure in drawn.items():
        if figure is None:
            continue
        for ending in ENDINGS:
            save_figure(figure, folder / f"{name}.{ending}", made_by="protomark bench")
        names.append(f"{name}.svg")
    return names


def draw_ratios(results: Results) -> Figure | None:
    """How many times as fast ours is as each peer, least and greatest round as a line."""
    from matplotlib.figure import Figure

    bars = [
        (contest, peer)
        for contest in results.contests
        for peer in contest.timings
        if not peer.ours
        and peer.comparable
        and contest.section != "add"
        and contest.recall in (None, RECALL)
    ]
    if not bars:
        return None
    figure = Figure(figsize=(9, 1 + 0.24 * len(bars)), layout="constrained")
    axes = figure.add_subplot()
    for row, (contest, peer) in enumerate(bars):
        ratio = contest.ratio(peer)
        if ratio is None:
            continue
        colour = OURS if ratio.median >= 1 else MUTED
        axes.barh(row, ratio.median - 1, left=1, height=0.62, color=colour)
        axes.hlines(row, ratio.low, ratio.high, color=INK, linewidth=1)
        axes.annotate(
            f" {ratio.median:.1f}",
            (max(ratio.median, ratio.high), row),
            va="center",
            color=INK,
            fontsize=7,
        )
    axes.set_yticks(range(len(bars)), [_label(*bar) for bar in bars], fontsize=7)
    axes.set_ylim(len(bars) - 0.4, -0.6)
    axes.set_xscale("log")
    axes.axvline(1, color=INK, linewidth=1)
    axes.set_title(
        "Protomark is faster by a factor of", loc="left", color=INK, fontsize=11, fontweight="bold"
    )
    style_axes(axes, "peer's time / ours, same run, same threads (log)", "")
    axes.grid(visible=False, axis="y")
    return figure


def draw_growth(results: Results) -> Figure | None:
    """Time of a query and memory against landmarks, both axes logarithmic."""
    from matplotlib.figure import Figure

    if not results.growth:
        return None
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    times, memory = figure.subplots(1, 2)
    for method, colour in _COLOURS.items():
        points = [p for p in results.growth if p["method"] == method]
        known = [p for p in points if p["bytes"] is not None]
        style = {"color": colour, "marker": "o", "linewidth": 2, "markersize": 5, "label": method}
        times.plot([p["landmarks"] for p in points], [1000 * p["seconds"] for p in points], **style)
        memory.plot(
            [p["landmarks"] for p in known],
            [p["bytes"] * p["landmarks"] / 2**20 for p in known],
            **style,
        )
    n = results.large.get("landmarks")
    for bits in (8, 4):
        if n and f"{bits} bits: file bytes" in results.large:
            note = f"sealed file, {bits} bits"
            if all(point["landmarks"] != n for point in results.growth):
                seconds = results.large[f"{bits} bits: 1,000 queries, seconds"]
                times.plot(n, seconds, "D", color=_COLOURS["approximate"])
                conditions = "sealed, 2 threads,\nrecall 0.95" if bits == 8 else ""
                times.annotate(conditions, (n, seconds), fontsize=7, ha="right", va="bottom")
            size = results.large[f"{bits} bits: file bytes"] / 2**20
            memory.plot(n, size, "D", color=_COLOURS["approximate"])
            memory.annotate(note, (n, size), fontsize=7, ha="right")
    for axes, title, label in (
        (times, "Time against landmarks", "ms a query (log)"),
        (memory, "Memory of the open map, or the sealed file", "MiB (log)"),
    ):
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_title(title, loc="left", color=INK, fontsize=11, fontweight="bold")
        axes.legend(frameon=False, labelcolor=INK, fontsize=9)
        style_axes(axes, "landmarks (log)", label)
    return figure


def _label(contest: Contest, peer: Timing) -> str:
    return f"{contest.section}, {contest.title}: {peer.name}"
