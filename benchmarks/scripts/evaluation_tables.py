"""Writes the tables of docs/results/evaluation.md and of the encoders' cards.

python benchmarks/scripts/evaluation_tables.py [RESULTS.json ...]

Without arguments, the script reads all benchmarks/results/evaluation.*.json, which `protomark
evaluate --json` wrote. Methods of one sequence may come from several files; the last file that
contains a method counts. Results of `--split later` give a table of their own.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from protomark.evaluation.methods import method_choices
from protomark.evaluation.results import (
    FORMAT,
    MethodResult,
    SequenceResult,
    group_by_descriptor,
    mean_rows,
    save_precision_plot,
    summary_markdown,
)
from protomark.features.descriptors import DESCRIPTORS
from protomark.files import write_text
from protomark.plot import SERIES, Curve, draw_curves, new_figure, save_figure
from protomark_bench.report import ReportTable, load_json, number

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"
DOCUMENT = ROOT / "docs" / "results" / "evaluation.md"
MODELS = ROOT / "python" / "protomark" / "models"
DIMS = (8, 16, 32, 64)
SIZES = (9, 17, 25, 33, 65)
SETS = {
    "train": ("hololens", "desk_rpy", "viking", "conch", "seneca"),
    "validation": ("caliterra",),
    "test": ("toy", "kitchen", "castle", "kitti07"),
}
COLUMNS = {
    "unaggregated": "all",
    "medoid": "medoid",
    "majority": "majority",
    "clusters": "clusters",
    **{f"pca-{dim}": f"PCA {dim}" for dim in (16, 32, 64)},
    "pq-32": "PQ 32 B",
    "itq-32": "ITQ 32 B",
    "lsh-32": "LSH 32 B",
    **{f"protomark-{dim}": f"**{dim}**" for dim in DIMS},
    **{f"sealed-{size}": f"**{size} B**" for size in SIZES},
    **{f"appearances-{size}": f"**by appearances, {size} B**" for size in SIZES},
}
# Families of methods that are compared at equal bytes, and how many more bytes than its name says a
# method takes, for the count. Signs need no count, so they take a byte less.
BUDGETS = {
    "PQ of the mean": ("pq", 1),
    "ITQ": ("itq", 1),
    "LSH": ("lsh", 1),
    "int8 means": ("protomark", 1),
    "sealed, untuned": ("untuned", 0),
    "tuned by appearances": ("appearances", 0),
    "tuned by observations": ("sealed", 0),
}
PAPER = {65: 0.849}  # Komorowski and Trzcinski, 16 float32 numbers and the count: 0.676 of 0.796


def load_results(path: Path) -> list[SequenceResult]:
    """Reads what `protomark evaluate --json` wrote."""
    results = []
    for entry in load_json(path, FORMAT)["sequences"]:
        del entry["table"]
        methods = [MethodResult(**method) for method in entry.pop("methods")]
        results.append(SequenceResult(**entry, methods=methods))
    return results


def replace_tables(document: Path, tables: str) -> None:
    """Puts tables between the document's marks, or with marks at its end if it has none."""
    start, end = "<!-- tables: start -->", "<!-- tables: end -->"
    text = document.read_text(encoding="utf-8")
    if start not in text:
        text = f"{text.rstrip()}\n\n{start}\n{end}\n"
    before, rest = text.split(start)
    _, after = rest.split(end)
    write_text(document, f"{before}{start}\n\n{tables}\n\n{end}{after}")


def set_of(sequence: str) -> str:
    """Whether the shipped encoders use a sequence for training, validation or test."""
    return next(name for name, members in SETS.items() if sequence in members)


def joined(results: Sequence[SequenceResult]) -> list[SequenceResult]:
    """One result per descriptor, sequence and split, with all methods measured on its queries.

    Raises:
        ValueError: two files measured a sequence on other queries.
    """
    families = [choice.family for choice in method_choices()]
    families += ["clusters", "protomark"]
    families += [f"protomark-{kind}" for kind in ("sealed", "appearances", "untuned")]
    whole: dict[tuple[str, str, str], SequenceResult] = {}
    for result in results:
        first = whole.setdefault((result.descriptor, result.sequence, result.split), result)
        if (first.queries, first.seeds) != (result.queries, result.seeds):
            raise ValueError(
                f"{result.sequence}, {result.descriptor}, {result.split} split: measured on other "
                "queries in another file; evaluate both on the same tracks and seeds"
            )
        methods = {method.name: method for method in [*first.methods, *result.methods]}
        first.methods = sorted(
            methods.values(),
            key=lambda m: (families.index(m.family), m.bytes_per_landmark[0]),
        )
    return list(whole.values())


def precision_table(results: Sequence[SequenceResult], names: Sequence[str]) -> ReportTable:
    """Precision of those of these methods that were measured, a row per sequence."""
    figures = [{row.name: row.precision for row in result.rows()} for result in results]
    names = [name for name in names if any(name in found for found in figures)]
    rows = [
        [result.sequence, set_of(result.sequence), *(number(found.get(name)) for name in names)]
        for result, found in zip(results, figures, strict=True)
    ]
    return ReportTable(["sequence", "set", *(COLUMNS[n] for n in names)], rows, words=2)


def ratio_table(results: Sequence[SequenceResult]) -> str:
    """Mean share of the unaggregated precision, by bytes per landmark."""
    ratios = {row.name: row.ratio for row in mean_rows(results)}
    paper = PAPER if (results[0].descriptor, results[0].split) == ("freak", "random") else {}
    heads = [
        head
        for head, (name, count) in BUDGETS.items()
        if any(f"{name}-{size - count}" in ratios for size in SIZES)
    ]
    rows = [
        [
            f"{size}",
            number(paper.get(size)),
            *(number(ratios.get(f"{BUDGETS[h][0]}-{size - BUDGETS[h][1]}")) for h in heads),
        ]
        for size in SIZES
    ]
    names = ", ".join(result.sequence for result in results)
    title = f"Mean ratio to the unaggregated precision ({names}):"
    table = ReportTable(["bytes per landmark", "paper", *heads], rows, words=0)
    return f"{title}\n\n{table.markdown()}"


def revisits_text(results: Sequence[SequenceResult]) -> str:
    """Precision and ratios where later keyframes ask a map of the earlier ones."""
    names = ["unaggregated", "medoid", "majority", "pq-32", "itq-32", "lsh-32"]
    names += [f"sealed-{size}" for size in SIZES]
    return f"{precision_table(results, names).markdown()}\n\n{ratio_table(results)}"


def descriptors_text(results: Sequence[SequenceResult], plot: Path) -> str:
    """Which descriptor finds most landmarks in a frame, and in how many bytes; draws `plot`, too.

    The means are over the sequences that were measured with every descriptor. What each measures is
    the same images, at most 2,000 keypoints of the detector that goes with it, and the landmarks
    that it could triangulate. SIFT's tracks are made otherwise.
    """
    groups = group_by_descriptor([r for r in results if DESCRIPTORS[r.descriptor].input == "bits"])
    common = set.intersection(*({r.sequence for r in same} for same in groups.values()))
    names = ["unaggregated", "medoid", *(f"sealed-{size}" for size in SIZES)]
    rows, curves = [], []
    for i, (descriptor, same) in enumerate(groups.items()):
        same = [result for result in same if result.sequence in common]
        landmarks = float(np.mean([result.map_landmarks for result in same]))
        found = {row.name: row for row in mean_rows(same)}
        per_frame = {
            name: row.landmarks_per_frame for name, row in found.items() if row.landmarks_per_frame
        }
        sealed = [name for name in names[2:] if name in per_frame]
        if not sealed:
            continue
        frames = sum(result.methods[0].frames for result in same)
        cells = [number(per_frame.get(name), ",.0f") for name in names]
        rows.append([descriptor.upper(), f"{frames}", f"{landmarks:,.0f}", *cells])
        curves.append(
            Curve(
                descriptor.upper(),
                [found[name].bytes_per_landmark * landmarks / 1000 for name in sealed],
                [per_frame[name] or 0.0 for name in sealed],
                [0.0] * len(sealed),
                SERIES[i % len(SERIES)],
            )
        )
    if len(rows) < 2:
        return ""
    figure = new_figure(8, 5)
    title = "Landmarks found per frame, sealed maps"
    axes = figure.add_subplot()
    draw_curves(axes, curves, "kilobytes per map, without positions (log)", "landmarks", title)
    # Labels right of the last points are only drawn within the axes.
    axes.set_xlim(right=1.5 * max(curve.x[-1] for curve in curves))
    save_figure(figure, plot, made_by="evaluation_tables.py")
    heads = ["descriptor", "frames", "landmarks in the map"]
    heads += [COLUMNS[name].replace("**", "") for name in names]
    order = [r.sequence for r in results if r.sequence in common]
    return "\n\n".join(
        [
            "## Which descriptor",
            "Landmarks that a query frame finds: those that are the nearest of one of its "
            "keypoints, and rightly, so that a pose can stand on them. A landmark is right if it "
            "is the keypoint's own, or projects to within 0.5 % of the image's longer side of it. "
            "All descriptors saw the same images, with at most 2,000 keypoints of the detector "
            "that each goes with, and have the landmarks that could be triangulated by them. "
            f"Random split, mean of {', '.join(dict.fromkeys(order))}.",
            ReportTable(heads, rows).markdown(),
            f"![{title}]({plot.name})",
        ]
    )


def card_text(results: Sequence[SequenceResult]) -> str:
    """The card's section on the test sequences; all results are of its descriptor."""
    names = ["unaggregated", "medoid", "majority", *(f"protomark-{dim}" for dim in DIMS)]
    missing = [name for name in SETS["test"] if name not in {r.sequence for r in results}]
    measured = {row.name for result in results for row in result.rows()}
    sealed = [f"sealed-{size}" for size in SIZES if f"sealed-{size}" in measured]
    parts = [
        "## Test sequences",
        "Measured once training was over; nothing was chosen by them. Integer encoder, int8\n"
        "prototypes, mean of three splits, as `protomark evaluate` measures.",
        precision_table(results, names).markdown(),
        f"Not measured: {', '.join(missing)}." if missing else "",
        "Sealed maps, by bytes per landmark:" if sealed else "",
        precision_table(results, sealed).markdown() if sealed else "",
        ratio_table(results),
    ]
    return "\n\n".join(part for part in parts if part)


def upright_table(plain: Sequence[SequenceResult], upright: Sequence[SequenceResult]) -> str:
    """Precision without and with angle and size of the keypoint, a row per sequence."""
    names = ["protomark-32", *(f"sealed-{size}" for size in SIZES)]
    others = {result.sequence: result for result in upright}
    rows = []
    for result in plain:
        if result.sequence in others and result.split == "random":
            one = {row.name: row.precision for row in result.rows()}
            other = {row.name: row.precision for row in others[result.sequence].rows()}
            cells = [f"{one[name]:.3f}, {other[name]:.3f}" for name in names]
            rows.append([result.sequence, f"{one['unaggregated']:.3f}", *cells])
    heads = ["sequence", "all", *(f"{COLUMNS[name].strip('*')}: plain, upright" for name in names)]
    title = "Plain, and with angle and size of the keypoint:"
    return f"{title}\n\n{ReportTable(heads, rows).markdown()}"


def corners_table(
    oriented: Sequence[SequenceResult],
    by_orb: Sequence[SequenceResult],
    by_own: Sequence[SequenceResult],
) -> str:
    """Shares of the unaggregated precision of RTAB-Map's ORB by both encoders, beside usual ORB."""
    sizes = [f"sealed-{size}" for size in SIZES if size != 25]
    columns = [{r.sequence: r for r in same} for same in (oriented, by_orb, by_own)]
    rows = []
    for sequence in columns[1]:
        found = [
            {row.name: row for row in same[sequence].rows()} if sequence in same else {}
            for same in columns
        ]
        precision = [number(f["unaggregated"].precision) if f else "–" for f in found[:2]]
        shares = [
            ", ".join(number(f[name].ratio) if name in f else "–" for f in found) for name in sizes
        ]
        rows.append([sequence, set_of(sequence), ", ".join(precision), *shares])
    heads = ["sequence", "set", "all: ORB, GFTT"]
    heads += [f"{COLUMNS[name].strip('*')}: ORB, `orb`, **`orb-gftt`**" for name in sizes]
    title = (
        "Share of the unaggregated precision: ORB as above, and upright ORB at GFTT corners "
        "(`benchmarks/scripts/gftt_tracks.py`) by the encoders `orb` and `orb-gftt`. *All* is the "
        "unaggregated precision of both."
    )
    return f"{title}\n\n{ReportTable(heads, rows, words=3).markdown()}"


def main() -> None:
    """Writes the tables."""
    paths = [Path(p) for p in sys.argv[1:]] or sorted(RESULTS.glob("evaluation.*.json"))
    order = [name for members in SETS.values() for name in members]
    results = sorted(
        joined([result for path in paths for result in load_results(path)]),
        key=lambda result: (result.descriptor, order.index(result.sequence)),
    )
    splits = {kind: [r for r in results if r.split == kind] for kind in ("random", "later")}
    parts = [descriptors_text(splits["random"], DOCUMENT.parent / "descriptors.png")]
    later = group_by_descriptor(splits["later"])
    for descriptor, same in group_by_descriptor(splits["random"]).items():
        parts += [f"## {descriptor.upper()}", precision_table(same, list(COLUMNS)).markdown()]
        tests = [result for result in same if set_of(result.sequence) == "test"]
        if tests:
            title = f"{descriptor.upper()}: mean of {', '.join(r.sequence for r in tests)}"
            save_precision_plot(
                mean_rows(tests), DOCUMENT.parent / f"precision.{descriptor}.png", title
            )
            parts += [ratio_table(tests), f"![{title}](precision.{descriptor}.png)"]
            parts += [f"### {title}", summary_markdown(mean_rows(tests)).rstrip()]
            replace_tables(MODELS / f"{descriptor}.md", card_text(tests))
        if descriptor in later:
            parts += [f"### {descriptor.upper()}: revisits", revisits_text(later[descriptor])]
        upright = RESULTS / f"upright.{descriptor}.json"
        if upright.is_file():
            table = upright_table(same, load_results(upright))
            parts += [f"### Cameras that do not roll: `{descriptor}-upright`", table]
            card = MODELS / f"{descriptor}-upright.md"
            replace_tables(card, f"## Beside the plain encoder\n\n{table}")
        corners = [RESULTS / f"gftt.{name}.json" for name in (descriptor, f"{descriptor}-gftt")]
        if all(path.is_file() for path in corners):
            table = corners_table(same, *map(load_results, corners))
            parts += [f"### RTAB-Map's GFTT/ORB: `{descriptor}-gftt`", table]
            card = MODELS / f"{descriptor}-gftt.md"
            replace_tables(card, f"## Beside the encoder `{descriptor}`\n\n{table}")
        sift = RESULTS / f"sift.{descriptor}.json"
        if sift.is_file():
            found = load_results(sift)
            table = precision_table(found, list(COLUMNS)).markdown()
            title = f"### {descriptor.upper()} at keypoints and matches of SIFT"
            parts += [title, table, ratio_table(found)]
    replace_tables(DOCUMENT, "\n\n".join(part for part in parts if part))


if __name__ == "__main__":
    main()
