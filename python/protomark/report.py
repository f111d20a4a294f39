"""Text of reports: Markdown tables, and the HTML page of a map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from protomark.plot import INK, MUTED, RED, MapPictures, map_figures, svg_text

_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{title}</title>
<meta name="viewport" content="width=device-width">
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; color: {ink}; max-width: 70rem; margin: 2rem auto;
  padding: 0 1rem }}
table {{ border-collapse: collapse }} td {{ padding: .2rem 1.2rem .2rem 0; vertical-align: top }}
p.warning {{ border-left: .3rem solid {red}; padding-left: 1rem }}
td:first-child {{ color: {muted} }} svg {{ max-width: 100%; height: auto }}
</style>
<h1>{title}</h1>
{warnings}
<table>{rows}</table>
{plots}
<h2>Frames without a pose</h2>{unregistered}
<h2>Events</h2>{events}
</html>
"""


def markdown_table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    bold: Sequence[bool] = (),
    left: int = 1,
) -> str:
    """A GitHub table of rows of texts; columns after the first `left` align right.

    `bold` tells which rows are bold.
    """
    lines = [
        "| " + " | ".join(head) + " |",
        "|" + "---|" * left + "---:|" * (len(head) - left),
    ]
    marks = [*bold, *[False] * (len(rows) - len(bold))]
    for row, strong in zip(rows, marks, strict=True):
        lines.append("| " + " | ".join(f"**{c}**" if strong else c for c in row) + " |")
    return "\n".join(lines) + "\n"


def percent(share: float | None) -> str:
    """A share in percent, a dash for None."""
    return "–" if share is None else f"{100 * share:.1f}%"


def first_of(names: Sequence[str], limit: int = 3) -> str:
    """The first names of a list, and how many follow."""
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return ", ".join(names[:limit]) + more


def map_page(facts: Mapping[str, Any], pictures: MapPictures, title: str) -> str:
    """The report of a map as one HTML page with its plots."""
    events = "".join(f"<li>{escape(event)}" for event in facts["events"])
    return _PAGE.format(
        title=escape(title),
        ink=INK,
        red=RED,
        muted=MUTED,
        warnings="".join(f"<p class=warning>{escape(w)}" for w in _map_warnings(facts)),
        rows="".join(f"<tr><td>{escape(k)}<td>{escape(v)}" for k, v in map_rows(facts)),
        plots="\n".join(svg_text(figure) for figure in map_figures(pictures)),
        unregistered=_unregistered(facts["not_registered"]),
        events=f"<ul>{events}</ul>" if events else "<p>None.",
    )


def _map_warnings(facts: Mapping[str, Any]) -> list[str]:
    stopped = "This map was stopped before all frames were added: --resume continues it."
    return [*([] if facts["finished"] else [stopped]), *facts["warnings"]]


def track_rows(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Names and values of figures that `protomark.tracks.summary` has of tracks and of maps."""
    mean, median = facts["reprojection_error_mean"], facts["reprojection_error_median"]
    each = facts["track_length_mean"]
    return [
        ("landmarks", f"{facts['landmarks']:,}"),
        ("observations", f"{facts['observations']:,} ({each:.1f} per landmark)"),
        ("reprojection error", f"mean {mean:.2f} pixels, median {median:.2f}"),
    ]


def map_rows(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Names and values of figures of a map that `protomark map` made."""
    camera = facts["camera"]
    params = ", ".join(f"{p:.5g}" for p in camera["params"])
    memory, each = facts["memory_bytes"], facts["bytes_per_landmark"]
    descriptors = facts["descriptor_bytes"]
    sealed = facts.get("sealed_bytes")
    speed = facts["frames_per_second"]
    rate = f", {speed:.1f} frames per second" if speed else ""
    return [
        ("registered", f"{facts['registered']} of {facts['frames']} frames registered"),
        ("keyframes", f"{facts['keyframes']}"),
        *track_rows(facts),
        ("memory for matching", f"{memory:,} bytes, {each:.0f} per landmark"),
        (
            f"all {facts['descriptor']} descriptors",
            f"{descriptors:,} bytes, {descriptors / max(memory, 1):.1f} times as much",
        ),
        *([("sealed map", f"{sealed:,} bytes, with encoder and positions")] if sealed else []),
        ("camera", f"{camera['model']}, {camera['width']}x{camera['height']}: {params}"),
        *([("left out", facts["left_out"])] if facts["left_out"] else []),
        ("time", f"{facts['seconds_total']:.1f} s{rate}"),
    ]


def _unregistered(by_reason: Mapping[str, Sequence[str]]) -> str:
    if not by_reason:
        return "<p>None."
    items = (
        f"<li>{escape(reason)} ({len(names)}): {escape(first_of(names, 20))}"
        for reason, names in by_reason.items()
    )
    return f"<ul>{''.join(items)}</ul>"
