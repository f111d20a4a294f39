"""The report in Markdown, with the paper's numbers beside ours."""

from __future__ import annotations

from protomark.reproduce.paper import PRECISION_BY_DIM, SOURCE, TABLE
from protomark.reproduce.reading import reading, reasons
from protomark.reproduce.results import Results
from protomark.reproduce.training import LAYERS, OBJECTIVES, SEEDS, SHAPES


def markdown(results: Results) -> str:
    """The whole report; figures are taken to lie beside it."""
    limit = (
        f"at most {results.max_steps:,} steps a training"
        if results.max_steps
        else "trained until the validation loss stagnates for the third time"
    )
    parts = [
        f"# The paper reproduced, scale `{results.scale}`",
        f"{SOURCE}, run again by `protomark reproduce` on other sequences: "
        f"{results.descriptor.upper()} with {results.bits} bits, {limit}. The paper's numbers "
        "stand beside ours; as the sequences differ, what compares is the order, and the share of "
        "the unaggregated precision.",
        "## What comes out",
        _bullets(reading(results)),
        "What is unlike the paper here, and may explain what differs:",
        _bullets(reasons(results)),
        "## Networks",
        "Precision on validation "
        f"({', '.join(results.names('validation'))}), 16 outputs, one seed. Two layers are the "
        "same network in both shapes. The paper shows a figure without numbers.",
        "![Precision against depth](depth.svg)",
        _depth_table(results),
        _trainings_table(results),
        "## Dimensions",
        f"Precision on the test sequences ({', '.join(results.names('test'))}), mean, one seed.",
        "![Precision against dimension](dimension.svg)",
        _dimension_table(results),
        "## Methods",
        f"Mean over the test sequences; ± is the standard deviation over {len(SEEDS)} seeds, of "
        "the training and of the split together. Prototypes and PCA are float32, as in the "
        "paper. Bytes count all that matching needs of a landmark." + _own_rows(results),
        _methods_table(results),
        "Precision by sequence, mean over seeds:",
        _sequence_table(results),
        "## Conditions",
        _facts_table(results),
        _bullets(f"{name}: {value}" for name, value in results.conditions.items()),
    ]
    return "\n\n".join(parts) + "\n"


def _own_rows(results: Results) -> str:
    """What the rows are that the paper does not have."""
    text = ""
    for curve in results.curves[1:]:
        text += f" *Best on validation* is the network {curve.training.label}."
    if any(row.name.startswith("protomark") for row in results.rows):
        text += (
            " *Protomark* is the encoder that ships, with int8 prototypes: this project's own, not "
            "the paper's."
        )
    return text


def _bullets(texts: object) -> str:
    return "\n".join(f"- {text}" for text in texts)  # type: ignore[attr-defined]


def _table(heads: list[str], rows: list[list[str]], words: int = 1) -> str:
    """A GitHub table whose first `words` columns are text."""
    lines = [heads, ["---"] * words + ["---:"] * (len(heads) - words), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _depth_table(results: Results) -> str:
    rows = [
        [
            f"{shape}, {objective}",
            *(f"{results.point(objective, shape, n).precision:.3f}" for n in LAYERS),
        ]
        for objective in OBJECTIVES
        for shape in SHAPES
    ]
    return _table(["network and loss", *(f"{n} layers" for n in LAYERS)], rows)


def _trainings_table(results: Results) -> str:
    rows = [
        [
            p.training.label,
            "-".join(str(units) for units in (*p.hidden, p.training.dim)),
            f"{p.validation_loss:.4f}",
            f"{p.best_step:,}",
            f"{p.steps:,}",
            f"{p.seconds:,.0f}",
        ]
        for p in results.networks
    ]
    heads = ["training", "units", "validation loss", "at step", "steps", "seconds"]
    return (
        "<details><summary>All trainings of this comparison</summary>\n\n"
        + _table(heads, rows, words=2)
        + "\n\nLosses of different objectives do not compare.\n\n</details>"
    )


def _dimension_table(results: Results) -> str:
    dims = list(PRECISION_BY_DIM)
    whole = results.curves_unaggregated
    rows = []
    for curve in results.curves:
        name = f"ours: {curve.training.label}"
        rows.append([name, *(f"{curve.mean(d):.3f}" for d in dims)])
        rows.append(["… of unaggregated", *(f"{curve.mean(d) / whole:.3f}" for d in dims)])
    rows.append(["the paper", *(f"{PRECISION_BY_DIM[d]:.2f}" for d in dims)])
    theirs = [f"{PRECISION_BY_DIM[d] / TABLE['unaggregated']:.3f}" for d in dims]
    rows.append(["… of unaggregated", *theirs])
    return _table(["precision at", *(str(d) for d in dims)], rows)


def _methods_table(results: Results) -> str:
    rows = []
    for row in results.rows:
        theirs = row.paper
        rows.append(
            [
                row.label,
                f"{row.bytes_per_landmark:,.0f}",
                f"{row.mean:.3f} ± {row.spread:.3f}",
                f"{results.ratio(row):.3f} ± {results.ratio_spread(row):.3f}",
                "–" if theirs is None else f"{theirs:.3f}",
                "–" if theirs is None else f"{theirs / TABLE['unaggregated']:.3f}",
            ]
        )
    heads = ["method", "bytes", "ours", "of unaggregated", "paper", "of unaggregated"]
    return _table(heads, rows)


def _sequence_table(results: Results) -> str:
    names = results.names("test")
    rows = [
        [row.label, *(f"{sum(row.precision[n]) / len(row.precision[n]):.3f}" for n in names)]
        for row in results.rows
    ]
    return _table(["method", *names], rows)


def _facts_table(results: Results) -> str:
    rows = [
        [s.name, s.role, f"{s.keyframes:,}", f"{s.landmarks:,}", f"{s.observations:,}"]
        for s in results.sequences
    ]
    heads = ["sequence", "used for", "keyframes", "landmarks", "observations"]
    return _table(heads, rows, words=2)
