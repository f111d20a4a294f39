"""Write the tables of docs/evaluation.md and of the encoders' cards from an evaluation's JSON.

python benchmarks/evaluation_tables.py [RESULTS.json ...]

Without arguments: from all benchmarks/results/evaluation.*.json, which `protomark evaluate --json`
wrote. Exit code 1 if Protomark is not above PCA at equal bytes on every test sequence.
"""

from __future__ import annotations

import sys
from pathlib import Path

from documents import replace_tables
from protomark.evaluation.plot import save_plot
from protomark.evaluation.report import markdown
from protomark.evaluation.results import SequenceResult, load_json, mean_rows

ROOT = Path(__file__).parent.parent
DOCUMENT = ROOT / "docs" / "evaluation.md"
MODELS = ROOT / "python" / "protomark" / "models"
DIMS = (8, 16, 32)
SPLITS = {
    "train": ("hololens", "desk_rpy", "viking", "conch", "seneca"),
    "validation": ("caliterra",),
    "test": ("toy", "kitchen", "castle", "kitti07"),
}
COLUMNS = {
    "unaggregated": "all",
    "medoid": "medoid",
    "majority": "majority",
    "mean": "mean, float",
    "pca-8": "PCA 8",
    "discriminant-8": "discr. 8",
    "protomark-8": "**ours 8**",
    "pca-16": "PCA 16",
    "discriminant-16": "discr. 16",
    "protomark-16": "**ours 16**",
    "pca-32": "PCA 32",
    "discriminant-32": "discr. 32",
    "protomark-32": "**ours 32**",
}


def split_of(sequence: str) -> str:
    """Whether a sequence trained, validated or tests what ships."""
    return next(name for name, members in SPLITS.items() if sequence in members)


def overview(results: list[SequenceResult]) -> str:
    """Precision of the main methods, a row a sequence."""
    lines = [
        "| sequence | split | " + " | ".join(COLUMNS.values()) + " |",
        "|---|---|" + "---:|" * len(COLUMNS),
    ]
    for result in results:
        rows = {row.name: row for row in result.rows()}
        texts = []
        for name in COLUMNS:
            text = f"{rows[name].precision:.3f}" if name in rows else "–"
            texts.append(f"**{text}**" if name.startswith("protomark") else text)
        lines.append(
            f"| {result.sequence} | {split_of(result.sequence)} | " + " | ".join(texts) + " |"
        )
    return "\n".join(lines) + "\n"


def check(results: list[SequenceResult]) -> list[str]:
    """Where Protomark is not above PCA at equal bytes, on test sequences."""
    failures = []
    for result in results:
        rows = {row.name: row for row in result.rows()}
        if split_of(result.sequence) != "test":
            continue
        for dim in DIMS:
            ours, theirs = rows.get(f"protomark-{dim}"), rows[f"pca-{dim}"]
            if ours is None or ours.precision <= theirs.precision:
                mine = "none" if ours is None else f"{ours.precision:.3f}"
                failures.append(
                    f"{result.sequence} {result.descriptor} {dim}: "
                    f"{mine}, PCA {theirs.precision:.3f}"
                )
    return failures


def card_table(results: list[SequenceResult]) -> str:
    """What a card says of the test sequences; all results are of its descriptor."""
    head = ["sequence", "unaggregated", "medoid", "majority"]
    head += [f"{who}, {dim}" for dim in DIMS for who in ("ours", "PCA")]
    lines = [
        "## Test sequences",
        "",
        "Measured once training was over; nothing was chosen by them. Integer encoder, int8",
        "prototypes, mean of three splits, as `protomark evaluate` measures. *PCA* is fitted on",
        "each map's own support descriptors and stored in as many bytes.",
        "",
        "| " + " | ".join(head) + " |",
        "|---|" + "---:|" * (len(head) - 1),
    ]
    ratios: dict[int, list[float]] = {dim: [] for dim in DIMS}
    for result in results:
        rows = {row.name: row for row in result.rows()}
        names = ["unaggregated", "medoid", "majority"]
        names += [f"{who}-{dim}" for dim in DIMS for who in ("protomark", "pca")]
        figures = " | ".join(f"{rows[name].precision:.3f}" for name in names)
        lines.append(f"| {result.sequence} | {figures} |")
        for dim in DIMS:
            ratios[dim].append(rows[f"protomark-{dim}"].ratio or 0.0)
    means = ", ".join(f"{sum(r) / len(r):.3f} at {dim}" for dim, r in ratios.items())
    return "\n".join([*lines, "", f"Mean ratio to unaggregated: {means}."]) + "\n"


def main() -> int:
    """Write the tables and say what the check found."""
    paths = [Path(p) for p in sys.argv[1:]] or sorted(
        (ROOT / "benchmarks" / "results").glob("evaluation.*.json")
    )
    if not paths:
        print("no results: run `protomark evaluate ... --json` first", file=sys.stderr)
        return 1
    order = [name for members in SPLITS.values() for name in members]
    results = sorted(
        (result for path in paths for result in load_json(path)),
        key=lambda result: (result.descriptor, order.index(result.sequence)),
    )
    parts = []
    for descriptor in dict.fromkeys(result.descriptor for result in results):
        same = [result for result in results if result.descriptor == descriptor]
        parts.append(f"### {descriptor.upper()}\n\n{overview(same)}")
        plotted = [result for result in same if split_of(result.sequence) == "test"]
        if plotted:
            title = f"{descriptor.upper()}: mean of {', '.join(r.sequence for r in plotted)}"
            save_plot(mean_rows(plotted), DOCUMENT.parent / f"precision.{descriptor}.png", title)
            parts.append(f"![{title}](precision.{descriptor}.png)\n")
    parts.append("### Every figure\n")
    for split, members in SPLITS.items():
        chosen = [result for result in results if result.sequence in members]
        if chosen:
            parts.append(f"**Split: {split}**\n\n{markdown(chosen)}")
    replace_tables(DOCUMENT, "\n".join(parts))
    tests = [result for result in results if result.sequence in SPLITS["test"]]
    for descriptor in dict.fromkeys(result.descriptor for result in tests):
        card = MODELS / f"{descriptor}.md"
        if card.is_file():
            replace_tables(card, card_table([r for r in tests if r.descriptor == descriptor]))

    failures = check(results)
    for failure in failures:
        print(f"not above PCA: {failure}")
    if not failures:
        print("above PCA at equal bytes on every test sequence given")
    return 1 if failures else 0


if __name__ == "__main__":
    raise SystemExit(main())
