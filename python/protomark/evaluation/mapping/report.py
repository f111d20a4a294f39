"""The report in Markdown."""

from __future__ import annotations

from collections.abc import Iterable

from protomark.evaluation.mapping.reading import reading
from protomark.evaluation.mapping.results import Results, Run, SequenceResult
from protomark.evaluation.mapping.targets import Target, matching
from protomark.evaluation.mapping.variants import COLMAP, LABELS

HEADS = (
    "map of",
    "registered",
    "error",
    "% of extent",
    "landmarks",
    "KB",
    "B/landmark",
    "ms a frame",
    "matching",
    "whole search",
    "pixels",
)


def markdown(results: Results) -> str:
    """The whole report; its figures are taken to lie beside it."""
    parts = [
        "# Mapping evaluated",
        "The incremental pipeline of `protomark map` on whole sequences, its poses unknown, with "
        "several memories in the same code: all descriptors of every landmark, searched by Hamming "
        "distance (the traditional way), the medoid of each landmark, and prototypes. Beside it "
        "COLMAP's own incremental reconstruction with SIFT on the same images. Written by "
        "`protomark evaluate-mapping`.",
        f"**Scale of this run:** {results.conditions['scale']}. {_shares(results)}"
        + (f" **Not run:** {'; '.join(results.missing)}." if results.missing else ""),
        "## What comes out",
        _bullets(reading(results)),
        "## Targets",
        "Prototypes of 32 numbers (33 bytes) beside all descriptors. *Met* is said of the "
        "sequences and frames of this run only.",
        _targets_table(results),
        "## Runs",
        "Error: root mean square of the distance between camera centres after the best similarity "
        "(as `evo_ape -as`), in the unit of the true poses, and as a share of the diagonal of the "
        "box around the true cameras. KB: what matching needs of all landmarks at the end (their "
        "positions left out), 1 KB = 1000 bytes. Milliseconds are CPU time, all stages, last "
        "adjustment and second looks included; matching is encoding, searching, and the pose of a "
        "frame in the map, the search for the first two frames left out; whole search is a "
        "frame's descriptors against the whole map of the end, encoding included. Pixels: mean "
        "reprojection error. COLMAP's times are of "
        "features, matching of image pairs, and mapping; it keeps every descriptor of every image, "
        "128 bytes each.",
        *(_sequence(s) for s in results.sequences),
        "![Trajectories](trajectories.svg)",
        "## Memory over time",
        "![Memory over time](memory.svg)",
        _memory_table(results),
        "## Beside all descriptors",
        "![Ratios](ratios.svg)",
        "## Time by stage",
        _stages_table(results),
        *_localization(results),
        "## Drift of prototypes",
        "The pipeline adds to prototypes, takes observations back, merges and discards landmarks, "
        "frame after frame. A fresh map is made at once of the observations that were added and "
        "not taken back. Sums are exact, so both must be saved in the same bytes; precision is "
        "then the same on any queries. An observation that proves wrong after its descriptor is "
        "gone (*dropped*) leaves the geometry and stays in the prototype: so some landmarks are "
        "unlike those of a map made from the images of what the frames see at the end.",
        _drift_table(results),
        "## Conditions",
        _bullets(f"{name}: {value}" for name, value in results.conditions.items()),
        _truth(results),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def mark(met: bool | None) -> str:
    """Met, not met, or not measured."""
    return "not measured" if met is None else "met" if met else "**not met**"


def run_row(s: SequenceResult, run: Run) -> list[str]:
    """The cells of a run, as `HEADS`."""
    error = s.error(run.variant)
    return [
        LABELS.get(run.variant, run.variant),
        f"{run.registered} of {s.frames}",
        "–" if error is None else f"{error:.4g}",
        "–" if error is None or not s.extent else f"{100 * error / s.extent:.2f}",
        f"{run.landmarks:,}",
        "–" if run.memory_bytes is None else f"{run.memory_bytes / 1e3:,.0f}",
        "–"
        if run.memory_bytes is None or not run.landmarks
        else f"{run.memory_bytes / run.landmarks:.0f}",
        f"{1e3 * run.total / s.frames:.0f}",
        f"{1e3 * matching(run.seconds) / s.frames:.0f}",
        "–" if run.search_ms is None else f"{run.search_ms:.1f}",
        f"{run.error_pixels:.2f}",
    ]


def _shares(results: Results) -> str:
    return "; ".join(f"{s.name} {s.frames} of {s.available}" for s in results.sequences) + "."


def _bullets(texts: Iterable[str]) -> str:
    return "\n".join(f"- {text}" for text in texts)


def _table(heads: Iterable[str], rows: list[list[str]], words: int = 1) -> str:
    """A GitHub table whose first `words` columns are text."""
    heads = list(heads)
    lines = [heads, ["---"] * words + ["---:"] * (len(heads) - words), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _targets_table(results: Results) -> str:
    names = [s.name for s in results.sequences]

    def cells(target: Target) -> list[str]:
        out = []
        for name in names:
            text, met = target.measured.get(name, ("", None))
            out.append(f"{text} {'✓' if met else '✗'}" if met is not None else "–")
        others = [
            f"{name}: {text}" for name, (text, _) in target.measured.items() if name not in names
        ]
        return [target.name, "; ".join([target.wanted, *others]), mark(target.met), *out]

    return _table(["target", "wanted", "", *names], [cells(t) for t in results.targets], words=3)


def _sequence(s: SequenceResult) -> str:
    rows = [run_row(s, run) for run in s.runs.values()]
    return (
        f"**{s.name}**, {s.frames} frames, poses {s.truth}, extent {s.extent:.3g}\n\n"
        + _table(HEADS, rows)
        + _unfound(s)
    )


def _unfound(s: SequenceResult) -> str:
    lines = [
        f"{LABELS.get(run.variant, run.variant)}: "
        + "; ".join(f"{n} × {why}" for why, n in run.not_registered.items())
        for run in s.runs.values()
        if run.not_registered
    ]
    return "\n\nWithout a pose. " + ". ".join(lines) + "." if lines else ""


def _memory_table(results: Results) -> str:
    rows = []
    for s in results.sequences:
        for run in s.runs.values():
            if run.memory_bytes is None or run.peak_bytes is None:
                continue
            rows.append(
                [
                    s.name,
                    LABELS.get(run.variant, run.variant),
                    f"{run.memory_bytes:,}",
                    f"{run.peak_bytes:,}",
                    f"{run.peak_window_bytes or 0:,}",
                    "–" if run.open_bytes is None else f"{run.open_bytes:,}",
                ]
            )
    heads = ["sequence", "map of", "at the end", "peak", "peak with window", "open map"]
    return (
        _table(heads, rows, words=2)
        + "\n\nBytes. The window holds the descriptors of the last keyframes, which every variant "
        "needs to triangulate. An open map, which still takes observations, keeps sums of 16 bits; "
        "a sealed one has what stands under *at the end*. Medoids are counted alone, though the "
        "pipeline keeps all descriptors to choose them anew."
    )


def _stages_table(results: Results) -> str:
    rows = []
    for s in results.sequences:
        for run in s.runs.values():
            shown = [f"{stage} {1e3 * v / s.frames:.1f}" for stage, v in run.seconds.items() if v]
            rows.append(
                [
                    s.name,
                    LABELS.get(run.variant, run.variant),
                    ", ".join(shown),
                    f"{run.wall_seconds:.0f}",
                ]
            )
    return _table(["sequence", "map of", "CPU ms a frame", "seconds by the clock"], rows, words=3)


def _localization(results: Results) -> list[str]:
    if not results.recalls:
        return []
    rows = [
        [LABELS.get(r.variant, r.variant), f"{r.bytes_per_landmark:.0f}", f"{r.recall:.3f}"]
        for r in results.recalls
    ]
    return [
        "## Localization",
        f"The second half of {results.localized} ({results.recalls[0].frames} frames) localized in "
        "a map of its first half. Which matches to accept is fitted on "
        f"{', '.join(results.calibrated)}, for each kind of map alike.",
        _table(["map of", "B/landmark", "recall at 5 cm, 5°"], rows),
    ]


def _drift_table(results: Results) -> str:
    rows = []
    for s in results.sequences:
        for run in s.runs.values():
            if run.drift is None:
                continue
            d = run.drift
            rows.append(
                [
                    s.name,
                    LABELS.get(run.variant, run.variant),
                    "yes" if d.same_file else "**no**",
                    *(
                        f"{n:,}"
                        for n in (
                            d.landmarks,
                            d.observations,
                            d.unlike,
                            d.forgetful,
                            d.dropped,
                            d.unlike_frames,
                        )
                    ),
                ]
            )
    heads = ["sequence", "map of", "same bytes", "landmarks", "observations", "unlike"]
    heads += ["over 255", "dropped", "unlike the frames"]
    return _table(heads, rows, words=3) if rows else ""


def _truth(results: Results) -> str:
    if not any(s.truth.startswith("SfM") and COLMAP in s.runs for s in results.sequences):
        return ""
    return (
        "Poses by SfM are an incremental reconstruction with SIFT on all of these very images: "
        "there COLMAP is compared with its own kind, and its error says little."
    )
