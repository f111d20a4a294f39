"""`protomark evaluate-mapping` on a tiny room, and what its report is made of."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import protomark as pm
from mapping_scene import walk, write_images
from protomark.cli import app
from protomark.evaluation.mapping import colmap, pipeline
from protomark.evaluation.mapping.figures import NAMES
from protomark.evaluation.mapping.ledger import Ledger
from protomark.evaluation.mapping.reading import reading
from protomark.evaluation.mapping.results import Drift, Results, Run, SequenceResult
from protomark.evaluation.mapping.sequences import error, open_sequence
from protomark.evaluation.mapping.targets import targets
from protomark.evaluation.mapping.variants import choose
from tracks_scene import DISTORTED, PINHOLE, write_model, write_sequence

# The last but one of the frames shows another room: it is looked at again, and left out.
FRAMES, STRANGE = 8, 7
SAMPLE = Path(pm.__file__).parent / "sample" / "toy.freak.safetensors"
SHORT = ("-d", "freak", "--max-keypoints", 500, "--frames", FRAMES)


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "room"
    poses = walk(FRAMES + 2)
    write_images(folder / "images", poses)
    write_images(folder / "images", poses[-1:], seed=20, first=STRANGE)
    write_model(folder / "sparse", PINHOLE, [f"img{i + 1}.png" for i in range(len(poses))], poses)
    return folder


def run(*words):
    return CliRunner().invoke(app, [str(w) for w in ("evaluate-mapping", *words)])


def test_one_command_gives_the_report_and_a_second_run_maps_nothing(room, tmp_path, monkeypatch):
    out, facts = tmp_path / "out", tmp_path / "r.json"
    words = (room, "-o", out, *SHORT, "--variants", "traditional,prototypes-32", "--json", facts)
    words += ("--halves", SAMPLE, "--calibrate", SAMPLE)
    result = run(*words)
    assert result.exit_code == 0, result.output
    assert {p.name for p in out.iterdir()} == {"report.md", "report.json", "kept", *NAMES}
    found = json.loads(facts.read_text())
    assert found == json.loads((out / "report.json").read_text())
    (sequence,) = found["sequences"]
    assert (sequence["name"], sequence["frames"], sequence["available"]) == ("room", 8, 10)
    runs = {one["variant"]: one for one in sequence["runs"]}
    assert list(runs) == ["traditional", "prototypes-32", "colmap"]
    for one in runs.values():
        assert one["registered"] == FRAMES - 1
        assert sum(one["not_registered"].values()) == 1
        # Of a walk of 0.5: a map that is right, not only one that is there.
        assert one["error"] < 0.04
        assert sum(one["seconds"].values()) > 0
    ours, theirs = runs["prototypes-32"], runs["traditional"]
    assert ours["memory_bytes"] == 33 * ours["landmarks"] <= ours["peak_bytes"]
    assert theirs["memory_bytes"] == 64 * theirs["observations"]
    assert ours["peak_window_bytes"] > ours["peak_bytes"]
    drift = ours["drift"]
    assert drift["same_file"]
    assert drift["observations"] - drift["dropped"] == ours["observations"]
    aims = {t["name"]: t["measured"]["room"][1] for t in found["targets"][:-1]}
    assert aims["registered frames"] is aims["no drift"] is aims["beside COLMAP"] is True
    assert aims["descriptor memory"] is (6 * ours["memory_bytes"] <= theirs["memory_bytes"])
    report = (out / "report.md").read_text()
    for text in (
        "room 8 of 10",
        "| COLMAP, SIFT | 7 of 8 |",
        "memory.svg",
        "very bytes",
        "Without a pose. ",
    ):
        assert text in report
    assert "`protomark evaluate-mapping room --variants traditional,prototypes-32 " in report
    assert str(tmp_path) not in report
    for name in NAMES:
        assert "<svg" in (out / name).read_text()

    def no_run(*_):
        raise AssertionError("mapped again")

    monkeypatch.setattr(pipeline, "run", no_run)
    assert run(*words).exit_code == 0
    assert json.loads(facts.read_text())["sequences"] == found["sequences"]


def test_a_run_that_was_cut_goes_on(room, tmp_path, monkeypatch):
    real, calls = pipeline.run, []

    def cut(sequence, variant, *rest):
        calls.append(variant)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(sequence, variant, *rest)

    monkeypatch.setattr(pipeline, "run", cut)
    words = (room, "-o", tmp_path / "out", "--no-colmap", "--frames", 6, "--max-keypoints", 300)
    words += ("--variants", "medoid,prototypes-16")
    stopped = run(*words)
    assert stopped.exit_code == 130
    assert "the same command goes on" in stopped.output.replace("\n", " ")
    report = tmp_path / "out" / "report.md"
    assert "**Not run:** room, prototypes-16." in report.read_text()
    assert run(*words).exit_code == 0
    assert "Not run" not in report.read_text()
    assert calls == ["medoid", "prototypes-16", "prototypes-16"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("{room}", "--variants", "all"), "no variant 'all': choose from traditional"),
        (("{room}", "{room}"), "two sequences are named room"),
        (("{room}/images",), "no COLMAP model"),
        (("nowhere",), "nowhere: no such folder"),
        (("{room}", "--frames", "2"), "2 of 2 images have a pose"),
        (("{room}", "-o", "{room}/images/img1.png"), "not a folder"),
        (("{room}", "--halves", "x"), "--calibrate"),
        (("{room}", "--json", "no/such/r.json"), "no such folder to write r.json"),
    ],
)
def test_mistakes_are_one_sentence(room, tmp_path, words, message):
    words = [word.format(room=room) for word in words]
    result = run(*words, *(() if "-o" in words else ("-o", tmp_path / "out")))
    assert result.exit_code == 1
    assert re.search(message, str(result.exception))


def test_colmap_takes_a_known_camera_with_strong_distortion(tmp_path):
    sequence = open_sequence(write_sequence(tmp_path / "bent", DISTORTED, count=7))
    found = colmap.run(sequence, 1)
    assert found.registered == 7
    assert error(found.centers, sequence.centers) < 0.02


def test_every_nth_image_and_at_most_so_many(room):
    sequence = open_sequence(room, every=3, frames=3)
    assert sequence.source.names == ["img1.png", "img4.png", "img7.png"]
    assert sequence.available == FRAMES + 2
    assert list(sequence.poses) == sequence.source.names


def test_the_error_is_after_a_similarity_and_of_common_images():
    rng = np.random.default_rng(1)
    true = {f"{i}": rng.normal(size=3) for i in range(9)}
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    moved = {n: (4 * turn @ c + [1, 2, 3]).tolist() for n, c in true.items()}
    assert error(moved, true) == pytest.approx(0, abs=1e-9)
    moved["8"][0] += 8
    assert error(moved, true) > 0.3
    assert error(moved, true, set(true) - {"8"}) == pytest.approx(0, abs=1e-9)
    assert error(moved, {"1": true["1"]}) is None
    assert error({n: [0.0, 0.0, 0.0] for n in true}, true) is None


def test_a_ledger_holds_what_was_added_and_not_taken_back():
    encoder = pm.Encoder.load("freak")
    rng = np.random.default_rng(0)
    ledger = Ledger(encoder, 16)
    codes = encoder.encode(rng.integers(0, 256, (60, 64), dtype=np.uint8), 16)
    ids = np.arange(60) % 12
    for part in np.array_split(np.arange(60), 7):
        ledger.add(ids[part], codes[part])
    ledger.remove(ids[3:20], codes[3:20])
    ledger.merge(np.array([1, 2]), np.array([5, 6]))
    ledger.discard(np.array([4]))
    ledger.add(np.array([5]), codes[:1])
    held, kept = ledger.held()
    left = np.setdiff1d(np.arange(60), np.arange(3, 20))
    renamed = np.where(ids == 5, 1, np.where(ids == 6, 2, ids))
    left = left[renamed[left] != 4]
    expected = [(i, c.tobytes()) for i, c in zip(renamed[left], codes[left], strict=True)]
    expected.append((5, codes[0].tobytes()))
    assert sorted((i, c.tobytes()) for i, c in zip(held, kept, strict=True)) == sorted(expected)
    assert ledger.map.counts(np.array([1]))[0] == sum(i == 1 for i, _ in expected)


def _run(variant, frames, error, kilobytes, match, drift=None):
    centers = {f"{i}": [i + error * (-1) ** i, float(i**2), 0.0] for i in range(frames)}
    return Run(
        variant=variant,
        centers=centers,
        landmarks=100,
        observations=900,
        memory_bytes=None if variant == "colmap" else 1000 * kilobytes,
        peak_bytes=None if variant == "colmap" else 1000 * kilobytes,
        peak_window_bytes=None if variant == "colmap" else 2000 * kilobytes,
        open_bytes=None,
        seconds={"match": match, "adjust": 1.0},
        wall_seconds=2.0,
        search_ms=None,
        error_pixels=0.5,
        drift=drift,
    )


@pytest.mark.parametrize(
    ("ours", "met"),
    [
        ((20, 0.1, 6, 0.9), [True] * 5),
        ((18, 0.2, 7, 1.1), [False] * 5),
        ((19, 0.104, 6, 1.0), [False, True, True, False, True]),
    ],
)
def test_targets(ours, met):
    exact = Drift(100, 900, True, 0, 0, 0, 0)
    runs = {
        "traditional": _run("traditional", 20, 0.1, 36, 1.0),
        "prototypes-32": _run("prototypes-32", *ours, drift=exact),
        "colmap": _run("colmap", 20, 0.1, 0, 1.0),
    }
    poses = {
        f"{i}": np.column_stack([np.eye(3), [-i, -(i**2), 0.0]]).astype(float) for i in range(20)
    }
    sequence = SequenceResult("a", 20, 20, "as given", 1.0, poses, runs)
    results = Results([sequence], [], "", [], [], {})
    found = targets(results)
    assert [t.met for t in found[:5]] == met
    assert [t.met for t in found[5:]] == [True, None]
    verdict, *rest = reading(replace(results, targets=found))
    for target in found[:5]:
        assert (f"{target.name} (a)" in verdict) is not target.met
    assert "not measured: localization." in verdict
    assert f"take {36 / ours[2]:.1f} times the bytes" in "\n".join(rest)
    assert [v.name for v in choose([])] == [
        "traditional",
        "medoid",
        "prototypes-32",
        "prototypes-16",
    ]
