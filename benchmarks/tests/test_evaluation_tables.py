"""Tables of the evaluation, from results of both splits and of two descriptors."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

import evaluation_tables
from protomark.evaluation.protocol import SplitKind
from protomark.evaluation.results import MethodResult, SequenceResult, save_json


def result(descriptor: str, split: SplitKind, sequence: str, found: int) -> SequenceResult:
    """Sealed maps find `found` landmarks a frame at 33 bytes, and 10 more at 65."""

    def method(name: str, family: str, size: float, precision: float, more: int) -> MethodResult:
        return MethodResult(
            name, name, family, [size], [precision], [2.0], [0.1],
            frames=4, found=3, selected=40, right=30, landmarks_found=4 * (found + more),
        )  # fmt: skip

    return SequenceResult(
        sequence=sequence,
        descriptor=descriptor,
        split=split,
        keyframes=20,
        landmarks=2000,
        observations=9000,
        map_landmarks=1500.0,
        support_observations=8000.0,
        queries=400.0,
        scene_depth=6.0,
        seeds=[0],
        discriminant="support",
        methods=[
            method("unaggregated", "unaggregated", 300, 0.8, 20),
            method("itq-32", "itq", 32, 0.4, 0),
            method("sealed-33", "protomark-sealed", 33, 0.6 if split == "random" else 0.8, 0),
            method("sealed-65", "protomark-sealed", 65, 0.8, 10),
        ],
    )


def table_line(text: str, start: str) -> list[str]:
    (line,) = [line for line in text.splitlines() if line.startswith(f"| {start} |")]
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_tables_of_two_descriptors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    results = [
        result("freak", "random", "toy", 100),
        result("freak", "random", "castle", 200),
        result("freak", "later", "toy", 50),
        result("orb", "random", "toy", 300),
    ]
    # Part of the methods comes from another file.
    other = result("freak", "random", "castle", 200)
    other.methods, results[1].methods = other.methods[2:], results[1].methods[:2]
    save_json(results, tmp_path / "one.json")
    save_json([other], tmp_path / "other.json")
    for name in ("evaluation", "freak", "orb"):
        (tmp_path / f"{name}.md").write_text("Text.\n")
    monkeypatch.setattr(evaluation_tables, "DOCUMENT", tmp_path / "evaluation.md")
    monkeypatch.setattr(evaluation_tables, "MODELS", tmp_path)
    monkeypatch.setattr(evaluation_tables, "RESULTS", tmp_path)
    files = [str(tmp_path / name) for name in ("one.json", "other.json")]
    monkeypatch.setattr(sys, "argv", ["evaluation_tables.py", *files])
    evaluation_tables.main()
    text = (tmp_path / "evaluation.md").read_text()

    # Only `toy` is there with both descriptors.
    assert "mean of toy.\n" in text
    descriptors = text[: text.index("## FREAK")]
    heads = table_line(descriptors, "descriptor")
    for name, found in (("FREAK", 100), ("ORB", 300)):
        cells = dict(zip(heads, table_line(descriptors, name), strict=True))
        assert (cells["frames"], cells["landmarks in the map"]) == ("4", "1,500")
        assert (cells["all"], cells["33 B"], cells["65 B"]) == tuple(
            str(found + more) for more in (20, 0, 10)
        )
        assert cells["9 B"] == "–"
    assert (tmp_path / "descriptors.png").read_bytes().startswith(b"\x89PNG")

    # FREAK's mean of both sequences, its revisits, and ORB.
    # Methods that were not measured have no column.
    heads = ["bytes per landmark", "paper", "ITQ", "tuned by observations"]
    assert "PQ of the mean" not in text
    ratios = [line for line in text.splitlines() if line.startswith("| 33 |")]
    for line, sealed in zip(ratios, ("0.750", "1.000", "0.750"), strict=True):
        cells = dict(zip(heads, table_line(line, "33"), strict=True))
        assert (cells["ITQ"], cells["tuned by observations"]) == ("0.500", sealed)
    assert text.index("## FREAK") < text.index("### FREAK: revisits") < text.index("## ORB")
    assert "| 0.600 |" in (tmp_path / "freak.md").read_text()

    other.queries = 300.0
    save_json([other], tmp_path / "other.json")
    with pytest.raises(ValueError, match="castle, freak, random split: measured on other queries"):
        evaluation_tables.main()
