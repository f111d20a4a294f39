"""The report of a map: one HTML page with its plots inside."""

from __future__ import annotations

import io
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from protomark.evaluation.plot import GRID, INK, MUTED, OURS, style_axes
from protomark.evaluation.scene_plot import view_from_above
from protomark.files import write_text
from protomark.localization.absolute_pose import centre
from protomark.mapping.clock import STAGES
from protomark.mapping.history import REGISTERED
from protomark.mapping.mapper import Mapper

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = ("#0f766e", "#0369a1", "#4d7c0f", "#b45309", "#7c3aed", "#be123c", "#9ca3af")
_LANDMARKS_SHOWN = 20_000
_NAMES_SHOWN = 20

_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{title}</title>
<meta name="viewport" content="width=device-width">
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; color: {ink}; max-width: 70rem; margin: 2rem auto;
  padding: 0 1rem }}
table {{ border-collapse: collapse }} td {{ padding: .2rem 1.2rem .2rem 0; vertical-align: top }}
td:first-child {{ color: {muted} }} svg {{ max-width: 100%; height: auto }}
</style>
<h1>{title}</h1>
<table>{rows}</table>
{plots}
<h2>Frames without a pose</h2>{unfound}
<h2>What happened</h2>{events}
</html>
"""


def write_report(mapper: Mapper, facts: dict[str, Any], title: str, path: Path) -> None:
    """Write the page.

    Args:
        mapper: the map.
        facts: its figures, from `summarise`.
        title: heading.
        path: file to write.
    """
    plots = [_svg(_overview(mapper)), _svg(_growth(mapper)), _svg(_quality(mapper, facts))]
    write_text(
        path,
        _PAGE.format(
            title=escape(title),
            ink=INK,
            muted=MUTED,
            rows="".join(f"<tr><td>{escape(k)}<td>{escape(v)}" for k, v in _rows(facts)),
            plots="\n".join(plots),
            unfound=_unfound(facts),
            events="<ul>" + "".join(f"<li>{escape(e)}" for e in facts["events"]) + "</ul>"
            if facts["events"]
            else "<p>Nothing but frame after frame.",
        ),
    )


def _rows(facts: dict[str, Any]) -> list[tuple[str, str]]:
    ratio = facts["descriptor_bytes"] / max(facts["memory_bytes"], 1)
    camera = facts["camera"]
    params = ", ".join(f"{p:.5g}" for p in camera["params"])
    return [
        ("frames registered", f"{facts['registered']} of {facts['frames']}"),
        ("keyframes", f"{facts['keyframes']}"),
        ("landmarks", f"{facts['landmarks']}"),
        ("observations", f"{facts['observations']} ({facts['track_length_mean']:.1f} a landmark)"),
        (
            "reprojection error",
            f"mean {facts['reprojection_error_mean']:.2f} pixels, "
            f"median {facts['reprojection_error_median']:.2f}",
        ),
        (
            "memory for matching",
            f"{facts['memory']}: {facts['memory_bytes']:,} bytes, "
            f"{facts['bytes_per_landmark']:.0f} a landmark; all {facts['descriptor']} descriptors "
            f"of these observations: {facts['descriptor_bytes']:,} bytes, {ratio:.1f} times that",
        ),
        ("camera", f"{camera['model']}, {camera['width']}x{camera['height']}: {params}"),
        (
            "time",
            f"{facts['seconds_total']:.1f} s, {facts['frames_per_second']:.1f} frames a second",
        ),
    ]


def _unfound(facts: dict[str, Any]) -> str:
    if not facts["not_registered"]:
        return "<p>None."
    out = []
    for reason, names in facts["not_registered"].items():
        some = ", ".join(names[:_NAMES_SHOWN])
        more = len(names) - _NAMES_SHOWN
        out.append(
            f"<li>{escape(reason)} ({len(names)}): {escape(some)}"
            + (f" and {more} more" if more > 0 else "")
        )
    return f"<ul>{''.join(out)}</ul>"


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _svg(figure: Figure) -> str:
    import matplotlib

    text = io.StringIO()
    # A fixed salt: the same map gives the same page.
    with matplotlib.rc_context({"svg.hashsalt": "protomark", "svg.fonttype": "none"}):
        figure.savefig(text, format="svg", metadata={"Date": None})
    svg = text.getvalue()
    return svg[svg.index("<svg") :]


def _title(axes: Axes, text: str) -> None:
    axes.set_title(text, loc="left", color=INK, fontsize=11, fontweight="bold")


def _overview(mapper: Mapper) -> Figure:
    figure = _figure(11, 5.5)
    axes = figure.add_subplot()
    structure = mapper.structure
    _title(axes, "From above: landmarks by observations, and the camera's way")
    if not structure.frames:
        return figure
    frames = sorted(structure.frames, key=lambda f: (f.camera_id, f.index))
    poses = np.array([f.pose for f in frames])
    plane = view_from_above(poses)
    ids = structure.ids
    ids = ids[:: max(1, len(ids) // _LANDMARKS_SHOWN)]
    points = structure.positions[ids] @ plane.T
    counts = structure.counts(keyframes_only=False)[ids]
    path = centre(poses) @ plane.T
    if len(points):
        shown = axes.scatter(
            points[:, 0],
            points[:, 1],
            s=2,
            c=np.minimum(counts, 20),
            cmap="viridis",
            linewidths=0,
            rasterized=True,
        )
        figure.colorbar(shown, ax=axes, label="observations (20 and more: yellow)")
        low = np.minimum(np.quantile(points, 0.03, axis=0), path.min(0))
        high = np.maximum(np.quantile(points, 0.97, axis=0), path.max(0))
        middle, half = (low + high) / 2, 0.55 * float((high - low).max()) or 1.0
        axes.set_xlim(middle[0] - 1.6 * half, middle[0] + 1.6 * half)
        axes.set_ylim(middle[1] - half, middle[1] + half)
    axes.plot(*path.T, color="#dc2626", linewidth=1)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_color(GRID)
    return figure


def _growth(mapper: Mapper) -> Figure:
    figure = _figure(11, 3.8)
    left, right = figure.subplots(1, 2)
    entries = list(mapper.history.entries.values())
    x = np.arange(len(entries))
    for name, colour, label in (
        ("memory_bytes", OURS, f"map ({mapper.settings.memory})"),
        ("descriptor_bytes", MUTED, "all descriptors of the same observations"),
        ("window_bytes", "#b45309", "descriptors in the window"),
    ):
        values = np.array([getattr(e, name) for e in entries]) / 1e6
        left.plot(x, values, color=colour, label=label, linewidth=1.6)
    left.legend(frameon=False, fontsize=9, labelcolor=INK)
    style_axes(left, "frame", "MB")
    _title(left, "Descriptor memory")
    lost = [i for i, e in enumerate(entries) if e.outcome != REGISTERED]
    right.plot(x, [e.inliers for e in entries], color=OURS, linewidth=1)
    right.plot(lost, np.zeros(len(lost)), "x", color="#dc2626", label="no pose")
    if lost:
        right.legend(frameon=False, fontsize=9, labelcolor=INK)
    style_axes(right, "frame", "matches that agree with the pose")
    _title(right, "Matches with the map")
    return figure


def _quality(mapper: Mapper, facts: dict[str, Any]) -> Figure:
    figure = _figure(11, 3.8)
    left, middle, right = figure.subplots(1, 3)
    lengths = facts["track_length_histogram"]
    left.bar(list(lengths), list(lengths.values()), color=OURS)
    left.tick_params(axis="x", labelrotation=60)
    style_axes(left, "observations", "landmarks")
    _title(left, "Track lengths")
    structure = mapper.structure
    if structure.frames:
        errors = structure.errors(structure.observations(range(len(structure.frames))))
        errors = errors[np.isfinite(errors)]
        if len(errors):
            middle.hist(errors, bins=40, range=(0, np.quantile(errors, 0.995)), color=OURS)
    style_axes(middle, "pixels", "observations")
    _title(middle, "Reprojection error")
    entries = list(mapper.history.entries.values())
    base = np.zeros(len(entries))
    for stage, colour in zip(STAGES, _COLOURS, strict=True):
        values = np.array([1e3 * e.seconds.get(stage, 0.0) for e in entries])
        right.fill_between(
            np.arange(len(entries)), base, base + values, color=colour, label=stage, linewidth=0
        )
        base = base + values
    if len(base):
        right.set_ylim(0, 1.5 * float(np.quantile(base, 0.95)) + 1)
    right.legend(frameon=False, fontsize=8, labelcolor=INK, ncols=2)
    style_axes(right, "frame", "milliseconds")
    _title(right, "Time a frame")
    return figure
