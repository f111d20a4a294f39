"""What the report says follows from the numbers, whichever way they fall."""

from __future__ import annotations

import dataclasses

import pytest

from protomark.reproduce.paper import PRECISION_BY_DIM, TABLE
from protomark.reproduce.reading import reading, reasons
from protomark.reproduce.report import markdown
from protomark.reproduce.results import Curve, DepthPoint, Results, Row, SequenceFacts
from protomark.reproduce.training import PAPER_PICK, depth_trainings


def as_in_the_paper() -> Results:
    """Results that agree with the paper in everything."""
    points = []
    for training in depth_trainings():
        precision = 0.6 + (0.1 if training.objective == "triplet" else 0)
        precision -= 0.01 * abs(training.layers - 3)
        precision -= 0.001 if training.shape == "fat" and training.layers > 2 else 0
        hidden = training.hidden(512)
        points.append(DepthPoint(training, hidden, precision, 0.2, 400, 500, 9.0))
    shift = (-0.01, 0.0, 0.01)
    rows = [
        Row(name, name.capitalize(), 65, {s: [p + d for d in shift] for s in ("x", "y")})
        for name, p in TABLE.items()
    ]
    curve = Curve(
        PAPER_PICK, {d: {"x": p - 0.1, "y": p + 0.1} for d, p in PRECISION_BY_DIM.items()}
    )
    roles = (("t", "training"), ("v", "validation"), ("x", "test"), ("y", "test"))
    return Results(
        scale="small",
        max_steps=500,
        descriptor="freak",
        bits=512,
        sequences=[SequenceFacts(name, role, 10, 1000, 5000) for name, role in roles],
        depth=points,
        curves=[curve],
        rows=rows,
        conditions={"machine": "one"},
    )


def with_row(results: Results, name: str, precision: list[float]) -> Results:
    rows = [
        dataclasses.replace(row, precision={"x": precision, "y": row.precision["y"]})
        if row.name == name
        else row
        for row in results.rows
    ]
    return dataclasses.replace(results, rows=rows)


def test_agreement_is_said() -> None:
    results = as_in_the_paper()
    text = "\n".join(reading(results))
    for said in (
        "funnel, 3 layers, triplet (512-256-16) with 0.700, the paper's choice",
        "ahead in 7 of 7 pairs that differ in nothing else, by +0.100",
        "We find the same as they.",
        "so do 4 of our 4 combinations",
        "-0.001 with the triplet loss",
        "so they are here.",
        "+0.250, +0.100, +0.040, ending at 1.005",
        "It is the paper's order.",
    ):
        assert said in text
    assert len(results.networks) == 14
    assert "Random negatives" not in "\n".join(reasons(results))
    assert "0 of 14 had" in "\n".join(reasons(results))


def test_disagreement_is_said() -> None:
    results = as_in_the_paper()
    turned = [
        dataclasses.replace(p, precision=0.9 - p.precision, best_step=p.steps)
        for p in results.depth
    ]
    results = dataclasses.replace(results, depth=turned)
    # On average above PCA, although not at the last seed.
    results = with_row(results, "random", [0.9, 0.9, 0.2])
    text = "\n".join(reading(results))
    for said in (
        "has 0.200 and is number 14 of 14",
        "ahead in 0 of 7 pairs that differ in nothing else, by -0.100",
        "what they had expected, not what they found",
        "so do 0 of our 4 combinations",
        "random is above pca-16-float by 0.015 (on 1 of 2 sequences, not at every seed; in the "
        "paper it is 0.055 below)",
    ):
        assert said.lower() in text.lower()
    assert "14 of 14 had their lowest validation loss at the very end" in "\n".join(
        reasons(results)
    )


def test_easy_negatives_are_said() -> None:
    results = as_in_the_paper()
    easy = [dataclasses.replace(p, validation_loss=0.01) for p in results.depth]
    text = "\n".join(reasons(dataclasses.replace(results, depth=easy)))
    assert "a validation loss of 0.010 where the margin is 1" in text


def test_the_report_holds_every_number() -> None:
    results = as_in_the_paper()
    text = markdown(results)
    for row in results.rows:
        share = results.ratio(row)
        theirs = f"{row.paper:.3f} | {row.paper / 0.796:.3f} |"
        assert f"| {row.label} | 65 | {row.mean:.3f} ± 0.010 | {share:.3f} ± " in text
        assert theirs in text
    assert "| funnel, triplet | 0.690 | 0.700 | 0.690 | 0.680 |" in text
    assert "| fat, prototypical | 0.590 | 0.599 | 0.589 | 0.579 |" in text
    assert "| ours: funnel, 3 layers, triplet | 0.400 | 0.650 | 0.750 | 0.790 |" in text
    assert "at most 500 steps" in text
    whole = dataclasses.replace(results, max_steps=None)
    assert "until the validation loss stagnates for the third time" in markdown(whole)
    assert "The plateaus ended every training, after 500 to 500 steps" in markdown(whole)


def test_ratios_are_on_the_same_queries() -> None:
    results = with_row(as_in_the_paper(), "unaggregated", [0.5, 0.6, 0.7])
    row = results.row("random")
    expected = [
        a / b for a, b in zip(row.by_seed, results.row("unaggregated").by_seed, strict=True)
    ]
    assert results.ratios(row) == pytest.approx(expected)
    assert results.curves_unaggregated == pytest.approx((0.5 + 0.786) / 2)
