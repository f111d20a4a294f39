"""Writes the tables of docs/results/evaluation.md and of the encoders' cards.

python benchmarks/scripts/evaluation_tables.py [RESULTS.json ...]

Without arguments, the script reads all benchmarks/results/evaluation.*.json, which `protomark
evaluate --json` wrote. Methods of one sequence may come from several files; the last file that
contains a method counts.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from protomark.evaluation.methods import method_choices
from protomark.evaluation.results import (
    FORMAT,
    MethodResult,
    SequenceResult,
    mean_rows,
    save_precision_plot,
    summary_markdown,
)
from protomark.files import write_text
from protomark_bench.report import ReportTable, load_json, number

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"
DOCUMENT = ROOT / "docs" / "results" / "evaluation.md"
MODELS = ROOT / "python" / "protomark" / "models"
DIMS = (8, 16, 32, 64)
SIZES = (9, 17, 25, 33, 65)
SPLITS = {
    "train": ("hololens", "desk_rpy", "viking", "conch", "seneca"),
    "validation": ("caliterra",),
    "test": ("toy", "kitchen", "castle", "kitti07"),
}
COLUMNS = {
    "unaggregated": "all",
    "medoid": "medoid",
    "majority": "majority",
    **{f"pca-{dim}": f"PCA {dim}" for dim in (16, 32, 64)},
    **{f"protomark-{dim}": f"**{dim}**" for dim in DIMS},
    **{f"sealed-{size}": f"**{size} B**" for size in SIZES},
    **{f"appearances-{size}": f"**by appearances, {size} B**" for size in SIZES},
}
# Bytes per landmark -> methods of that size: int8 means; sealed maps, and what their parts bring.
BUDGETS = {
    size: (f"protomark-{size - 1}", f"untuned-{size}", f"appearances-{size}", f"sealed-{size}")
    for size in SIZES
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


def split_of(sequence: str) -> str:
    """Whether the shipped encoders use a sequence for training, validation or test."""
    return next(name for name, members in SPLITS.items() if sequence in members)


def joined(results: Sequence[SequenceResult]) -> list[SequenceResult]:
    """One result per descriptor and sequence, with all methods that were measured on its queries.

    Raises:
        ValueError: two files measured a sequence on other queries.
    """
    families = [choice.family for choice in method_choices()]
    families += ["protomark", "protomark-sealed", "protomark-appearances", "protomark-untuned"]
    whole: dict[tuple[str, str], SequenceResult] = {}
    for result in results:
        first = whole.setdefault((result.descriptor, result.sequence), result)
        if (first.queries, first.seeds) != (result.queries, result.seeds):
            raise ValueError(
                f"{result.sequence}, {result.descriptor}: measured on other queries in another "
                "file; evaluate both on the same tracks and seeds"
            )
        methods = {method.name: method for method in [*first.methods, *result.methods]}
        first.methods = sorted(
            methods.values(),
            key=lambda m: (families.index(m.family), m.bytes_per_landmark[0]),
        )
    return list(whole.values())


def precision_table(results: Sequence[SequenceResult], names: Sequence[str]) -> ReportTable:
    """Precision of these methods, a row per sequence."""
    rows = []
    for result in results:
        found = {row.name: row.precision for row in result.rows()}
        cells = [number(found.get(name)) for name in names]
        rows.append([result.sequence, split_of(result.sequence), *cells])
    return ReportTable(["sequence", "split", *(COLUMNS[n] for n in names)], rows, words=2)


def ratio_table(results: Sequence[SequenceResult]) -> str:
    """Mean share of the unaggregated precision, by bytes per landmark."""

    def mean_ratio(name: str | None) -> float | None:
        found = [row.ratio or 0.0 for r in results for row in r.rows() if row.name == name]
        return sum(found) / len(found) if found and len(found) == len(results) else None

    paper = PAPER if results[0].descriptor == "freak" else {}
    rows = [
        [f"{size}", number(paper.get(size)), *(number(mean_ratio(name)) for name in kept)]
        for size, kept in BUDGETS.items()
    ]
    heads = ["bytes per landmark", "paper", "int8 means"]
    heads += ["sealed, untuned", "tuned by appearances", "tuned by observations"]
    names = ", ".join(result.sequence for result in results)
    title = f"Mean ratio to the unaggregated precision ({names}):"
    return f"{title}\n\n{ReportTable(heads, rows, words=0).markdown()}"


def card_text(results: Sequence[SequenceResult]) -> str:
    """The card's section on the test sequences; all results are of its descriptor."""
    names = ["unaggregated", "medoid", "majority", *(f"protomark-{dim}" for dim in DIMS)]
    missing = [name for name in SPLITS["test"] if name not in {r.sequence for r in results}]
    parts = [
        "## Test sequences",
        "Measured once training was over; nothing was chosen by them. Integer encoder, int8\n"
        "prototypes, mean of three splits, as `protomark evaluate` measures.",
        precision_table(results, names).markdown(),
        f"Not measured: {', '.join(missing)}." if missing else "",
        "Sealed maps, by bytes per landmark:",
        precision_table(results, [f"sealed-{size}" for size in SIZES]).markdown(),
        ratio_table(results),
    ]
    return "\n\n".join(part for part in parts if part)


def upright_table(plain: Sequence[SequenceResult], upright: Sequence[SequenceResult]) -> str:
    """Precision without and with angle and size of the keypoint, a row per sequence."""
    names = ["protomark-32", *(f"sealed-{size}" for size in SIZES)]
    others = {result.sequence: result for result in upright}
    rows = []
    for result in plain:
        if result.sequence in others:
            one = {row.name: row.precision for row in result.rows()}
            other = {row.name: row.precision for row in others[result.sequence].rows()}
            cells = [f"{one[name]:.3f}, {other[name]:.3f}" for name in names]
            rows.append([result.sequence, f"{one['unaggregated']:.3f}", *cells])
    heads = ["sequence", "all", *(f"{COLUMNS[name].strip('*')}: plain, upright" for name in names)]
    title = "Plain, and with angle and size of the keypoint:"
    return f"{title}\n\n{ReportTable(heads, rows).markdown()}"


def main() -> None:
    """Writes the tables."""
    paths = [Path(p) for p in sys.argv[1:]] or sorted(RESULTS.glob("evaluation.*.json"))
    order = [name for members in SPLITS.values() for name in members]
    results = sorted(
        joined([result for path in paths for result in load_results(path)]),
        key=lambda result: (result.descriptor, order.index(result.sequence)),
    )
    parts = []
    for descriptor in dict.fromkeys(result.descriptor for result in results):
        same = [result for result in results if result.descriptor == descriptor]
        parts += [f"## {descriptor.upper()}", precision_table(same, list(COLUMNS)).markdown()]
        tests = [result for result in same if split_of(result.sequence) == "test"]
        if tests:
            title = f"{descriptor.upper()}: mean of {', '.join(r.sequence for r in tests)}"
            save_precision_plot(
                mean_rows(tests), DOCUMENT.parent / f"precision.{descriptor}.png", title
            )
            parts += [ratio_table(tests), f"![{title}](precision.{descriptor}.png)"]
            parts += [f"### {title}", summary_markdown(mean_rows(tests)).rstrip()]
            replace_tables(MODELS / f"{descriptor}.md", card_text(tests))
        upright = RESULTS / f"upright.{descriptor}.json"
        if upright.is_file():
            table = upright_table(same, load_results(upright))
            parts += [f"### Cameras that do not roll: `{descriptor}-upright`", table]
            card = MODELS / f"{descriptor}-upright.md"
            replace_tables(card, f"## Beside the plain encoder\n\n{table}")
    replace_tables(DOCUMENT, "\n\n".join(parts))


if __name__ == "__main__":
    main()
