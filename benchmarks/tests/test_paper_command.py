"""`protomark reproduce` on synthetic tracks with very short trainings."""

from __future__ import annotations

import json
import re
import sys

import pytest
from typer.testing import CliRunner

from protomark.cli import app
from protomark_bench.paper import scale, workers
from training_scene import scene

ROLES = ("--train", "a", "--train", "b", "--validation", "c", "--test", "d", "--test", "e")
OUTPUTS = [
    "reproduction.md",
    "reproduction.json",
    "reproduction-depth.svg",
    "reproduction-dimension.svg",
]
SEQUENCES = {"a": 1, "b": 2, "c": 3, "d": 4, "e": 5}
TRAININGS = 14 + 7  # the comparison of depth, and what the paper's network is tested with


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tracks")
    for name, seed in SEQUENCES.items():
        scene(landmarks=300, bits=64, seed=seed).save(folder / f"{name}.synthetic.safetensors")
    scene(seed=9, descriptor="else").save(folder / "f.synthetic.safetensors")
    return folder


@pytest.fixture(autouse=True)
def short(monkeypatch):
    tiny = scale.Scale("small", steps=4, epoch=2, patience=2, small=True)
    monkeypatch.setitem(scale.SCALES, "small", tiny)


def run(*words):
    words = ["reproduce", *words, "-d", "synthetic", "--jobs", 1]
    return CliRunner().invoke(app, list(map(str, words)))


def test_one_command_gives_the_report_and_a_second_run_trains_nothing(
    folder, tmp_path, monkeypatch
):
    out = tmp_path / "out"
    result = run(folder, *ROLES, "-o", out)
    assert result.exit_code == 0, result.output
    assert {p.name for p in out.iterdir()} == {*OUTPUTS, "cache"}
    figures = json.loads((out / "reproduction.json").read_text())
    assert (figures["scale"], figures["bits"], len(figures["depth"])) == ("small", 64, 16)
    assert [s["role"] for s in figures["sequences"]] == ["training"] * 2 + ["validation"] + [
        "test"
    ] * 2
    rows = {row["name"]: row for row in figures["rows"]}
    assert list(rows)[:6] == list(scale.TABLE)
    for row in rows.values():
        assert set(row["precision"]) == {"d", "e"}
        assert all(len(p) == 3 and 0 < min(p) <= max(p) <= 1 for p in row["precision"].values())
    assert rows["unaggregated"]["of_unaggregated"] == 1
    assert rows["majority"]["mean"] > rows["random"]["mean"]
    for curve in figures["curves"]:
        assert list(curve["precision"]) == ["8", "16", "32", "64"]
    # The dimension that both have is one measurement.
    assert (
        figures["curves"][0]["precision"]["16"]["d"] == rows["prototypes-16"]["precision"]["d"][0]
    )

    report = (out / "reproduction.md").read_text()
    for text in ("at most 4 steps", "(reproduction-depth.svg)", "| 0.796 |", "0.581"):
        assert text in report
    assert f"{rows['prototypes-32']['mean']:.3f}" in report
    assert str(tmp_path) not in report
    assert "<svg" in (out / "reproduction-dimension.svg").read_text()

    rewritten = run("--from", out / "reproduction.json", "-o", tmp_path / "again")
    assert rewritten.exit_code == 0, rewritten.output
    for name in OUTPUTS:
        assert (tmp_path / "again" / name).read_bytes() == (out / name).read_bytes()

    def no_training(*_):
        raise AssertionError("trained again")

    monkeypatch.setattr(workers, "train", no_training)
    again = run(folder, *ROLES, "-o", out)
    assert again.exit_code == 0, again.output
    assert json.loads((out / "reproduction.json").read_text())["rows"] == figures["rows"]


def test_a_run_that_was_cut_goes_on(folder, tmp_path, monkeypatch):
    out, real, calls = tmp_path / "out", workers.train, []

    def cut(training, *rest):
        calls.append(training)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return real(training, *rest)

    monkeypatch.setattr(workers, "train", cut)
    stopped = run(folder, *ROLES, "-o", out)
    assert stopped.exit_code == 130
    assert "the same command continues" in stopped.output.replace("\n", " ")
    assert len(list((out / "cache").iterdir())) == 3
    assert not (out / "reproduction.md").exists()
    assert run(folder, *ROLES, "-o", out).exit_code == 0
    # Three before the cut, the one that was cut, and every one but the three after it.
    cached = len(list((out / "cache").glob("*.safetensors")))
    assert cached >= TRAININGS
    assert len(calls) == cached + 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--scale", "huge"], "give small, medium, full"),
        (["--test", "z"], "no sequence is named z"),
        ([], "no training sequence among a, b, c, d, e, f"),
        ([*ROLES, "--test", "f"], "f.synthetic.*one descriptor"),
        (["--train", "f", "--validation", "c", "--test", "a"], "give tracks of one descriptor"),
        (["--from", "no/such.json"], "no/such.json"),
    ],
)
def test_mistakes_are_one_sentence(folder, tmp_path, words, message):
    result = run(folder, *words, "-o", tmp_path / "out")
    assert result.exit_code == 1
    (line,) = [line for line in str(result.exception).splitlines() if line]
    assert re.search(message, line)
    assert not (tmp_path / "out" / "reproduction.md").exists()


def test_the_output_must_be_a_folder(folder, tmp_path):
    (tmp_path / "file").touch()
    result = run(folder, *ROLES, "-o", tmp_path / "file")
    assert "not a folder" in str(result.exception)


def test_without_torch_it_says_what_to_install(folder, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    result = run(folder, *ROLES, "-o", tmp_path)
    assert re.search(r"needs PyTorch.*pip install .*\[train\]", str(result.exception))
