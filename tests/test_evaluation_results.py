"""Figures: means, ratios, JSON, tables and plots."""

from __future__ import annotations

import io
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from protomark.cli.evaluate import results_table
from protomark.evaluation.results import (
    MethodResult,
    SequenceResult,
    evaluation_markdown,
    mean_rows,
    save_json,
    save_precision_plot,
    summary_markdown,
)


def result(sequence: str = "ring", lift: float = 0.0, descriptor: str = "freak") -> SequenceResult:
    def method(name: str, family: str, size: float, precision: list[float]) -> MethodResult:
        return MethodResult(
            name, name.title(), family, [size] * 2, [p + lift for p in precision], [3.0, 5.0],
            [0.1, 0.1], frames=8, found=6, selected=40, right=30, landmarks_found=100,
        )  # fmt: skip

    return SequenceResult(
        sequence=sequence,
        descriptor=descriptor,
        split="random",
        keyframes=20,
        landmarks=400,
        observations=4000,
        map_landmarks=390,
        support_observations=3600,
        queries=400,
        scene_depth=6.0,
        seeds=[0, 1],
        discriminant="support",
        methods=[
            method("unaggregated", "unaggregated", 641, [0.7, 0.9]),
            method("protomark-16", "protomark", 17, [0.6, 0.6]),
            method("protomark-32", "protomark", 33, [0.7, 0.74]),
        ],
    )


def test_rows() -> None:
    whole, _, ours = result().rows()
    assert whole.ratio == 1
    assert ours.precision == pytest.approx(0.72)
    assert ours.spread == pytest.approx(np.std([0.7, 0.74], ddof=1))
    assert ours.ratio == pytest.approx(0.72 / 0.8)
    assert (ours.pose_recall, ours.right_share, ours.search_ms) == (0.75, 0.75, 3)
    assert ours.landmarks_per_frame == 12.5


def test_rows_without_what_was_not_measured() -> None:
    one = result()
    one.methods = one.methods[1:2]
    one.methods[0].precision = [0.6]
    one.methods[0].frames = one.methods[0].selected = 0
    row = one.rows()[0]
    assert row.spread is row.ratio is row.pose_recall is row.right_share is None
    assert row.landmarks_per_frame is None
    assert "–" in summary_markdown([row])


def test_means_over_sequences() -> None:
    first, second = result(), result("other", lift=0.1)
    second.methods = [second.methods[2], second.methods[0]]
    rows = mean_rows([first, second])
    assert [row.name for row in rows] == ["unaggregated", "protomark-32"]
    assert rows[1].precision == pytest.approx(0.77)
    assert rows[1].ratio == pytest.approx((0.72 / 0.8 + 0.82 / 0.9) / 2)


def test_json_holds_results_and_the_rows_of_their_tables(tmp_path: Path) -> None:
    results = [result(), result("other")]
    save_json(results, tmp_path / "r.json")
    document = json.loads((tmp_path / "r.json").read_text())
    assert document["format"] == "protomark-evaluation"
    for entry, one in zip(document["sequences"], results, strict=True):
        assert entry.pop("table") == [asdict(row) for row in one.rows()]
        assert entry == asdict(one)
    assert [p.name for p in tmp_path.iterdir()] == ["r.json"]


def test_markdown_has_a_table_a_sequence_and_a_mean_a_descriptor() -> None:
    text = evaluation_markdown([result(), result("other"), result(descriptor="orb")])
    assert text.count("|---|") == 4
    assert "FREAK, random split: mean of ring, other" in text
    assert "ORB, random split: mean" not in text
    assert "| **Protomark-32** | **33** | **0.720 ±0.028** | **90.0%** |" in text
    widths = {line.count("|") for line in text.splitlines() if line.startswith("|")}
    assert widths == {8}


def test_the_table_fits_a_terminal() -> None:
    from rich.console import Console

    console = Console(width=80, record=True, file=io.StringIO())
    rows = result().rows()
    rows[0].bytes_per_landmark = 12_345
    rows[0].search_ms = 1234
    console.print(results_table("title", rows))
    text = console.export_text()
    assert "…" not in text
    for shown in ("12,345", "0.800 ±0.141", "1,234"):
        assert shown in text


@pytest.mark.parametrize("ending", [".png", ".svg"])
def test_plots(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"plot{ending}"
    save_precision_plot(result().rows(), path, "title")
    save_precision_plot(result().rows(), path, "title")
    head = path.read_bytes()[:2000]
    assert head.startswith(b"\x89PNG") if ending == ".png" else b"<svg" in head
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_plot_needs_the_ending_of_a_picture(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"ends in \.png, \.svg or \.pdf"):
        save_precision_plot(result().rows(), tmp_path / "plot.txt")
