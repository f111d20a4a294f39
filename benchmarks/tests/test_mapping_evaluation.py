"""`protomark evaluate-mapping` on a tiny room, and the parts of its report."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from typer.testing import CliRunner

import protomark as pm
from mapping_scene import walk, write_images
from protomark.cli import app
from protomark_bench.mapping import colmap, pipeline
from protomark_bench.mapping.command import choose_memories
from protomark_bench.mapping.pipeline import RecordedPrototypes
from protomark_bench.mapping.sequences import error, open_sequence
from tracks_scene import DISTORTED, PINHOLE, write_model, write_sequence

# The last but one of the frames shows another room: it is looked at again, and left out.
FRAMES, STRANGE = 8, 7
PLOTS = ["mapping-trajectories.svg", "mapping-memory.svg", "mapping-ratios.svg"]
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
    out = tmp_path / "out"
    words = (room, "-o", out, *SHORT, "--memories", "traditional,prototypes-32")
    result = run(*words)
    assert result.exit_code == 0, result.output
    assert {p.name for p in out.iterdir()} == {"mapping.md", "mapping.json", "cache", *PLOTS}
    found = json.loads((out / "mapping.json").read_text())
    (sequence,) = found["sequences"]
    assert (sequence["name"], sequence["frames"], sequence["available"]) == ("room", 8, 10)
    runs = sequence["runs"]
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
    assert ours["common_errors"] == [ours["error"], theirs["error"]]
    report = (out / "mapping.md").read_text()
    for text in (
        "room 8 of 10",
        "| room | 8 | 7 : 7 : 7 |",
        "| COLMAP, SIFT | 7 of 8 |",
        "(mapping-memory.svg)",
        "Without a pose. ",
    ):
        assert text in report
    assert "`protomark evaluate-mapping room --memories traditional,prototypes-32 " in report
    assert str(tmp_path) not in report
    for name in PLOTS:
        assert "<svg" in (out / name).read_text()

    rewritten = run("--from", out / "mapping.json", "-o", tmp_path / "again")
    assert rewritten.exit_code == 0, rewritten.output
    for name in ("mapping.md", "mapping.json", *PLOTS):
        assert (tmp_path / "again" / name).read_bytes() == (out / name).read_bytes()

    def no_run(*_):
        raise AssertionError("mapped again")

    monkeypatch.setattr(pipeline, "run", no_run)
    assert run(*words).exit_code == 0
    assert json.loads((out / "mapping.json").read_text())["sequences"] == found["sequences"]


def test_a_run_that_was_cut_goes_on(room, tmp_path, monkeypatch):
    real, calls = pipeline.run, []

    def cut(sequence, memory, *rest):
        calls.append(memory)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(sequence, memory, *rest)

    monkeypatch.setattr(pipeline, "run", cut)
    words = (room, "-o", tmp_path / "out", "--no-colmap", "--frames", 6, "--max-keypoints", 300)
    words += ("--memories", "medoid,prototypes-16")
    stopped = run(*words)
    assert stopped.exit_code == 130
    assert "the same command continues" in stopped.output.replace("\n", " ")
    report = tmp_path / "out" / "mapping.md"
    assert "**Not run:** room, prototypes-16." in report.read_text()
    assert run(*words).exit_code == 0
    assert "Not run" not in report.read_text()
    assert calls == ["medoid", "prototypes-16", "prototypes-16"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("{room}", "--memories", "all"), "no memory 'all': choose from traditional"),
        (("{room}", "{room}"), "two sequences are named room"),
        (("{room}/images",), "no COLMAP model"),
        (("nowhere",), "nowhere: no such folder"),
        (("{room}", "--frames", "2"), "2 of 2 images have a pose"),
        (("{room}", "-o", "{room}/images/img1.png"), "not a folder"),
        ((), "name folders of sequences"),
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
    assert sequence.source.names() == ["img1.png", "img4.png", "img7.png"]
    assert sequence.available == FRAMES + 2
    assert list(sequence.poses) == sequence.source.names()


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


def test_the_record_holds_what_was_added_and_not_subtracted():
    encoder = pm.Encoder.load("freak")
    rng = np.random.default_rng(0)
    memory = RecordedPrototypes(encoder, 16)
    codes = encoder.encode(rng.integers(0, 256, (60, 64), dtype=np.uint8), 16)
    ids = np.arange(60) % 12
    for part in np.array_split(np.arange(60), 7):
        memory.add(ids[part], codes[part])
    memory.subtract(ids[3:20], codes[3:20])
    memory.merge_landmarks(np.array([1, 2]), np.array([5, 6]))
    memory.remove(np.array([4]))
    memory.add(np.array([5]), codes[:1])
    held, found = memory.observations()
    left = np.setdiff1d(np.arange(60), np.arange(3, 20))
    renamed = np.where(ids == 5, 1, np.where(ids == 6, 2, ids))
    left = left[renamed[left] != 4]
    expected = [(i, c.tobytes()) for i, c in zip(renamed[left], codes[left], strict=True)]
    expected.append((5, codes[0].tobytes()))
    assert sorted((i, c.tobytes()) for i, c in zip(held, found, strict=True)) == sorted(expected)
    assert memory.map.counts(np.array([1]))[0] == sum(i == 1 for i, _ in expected)


def test_memories_are_chosen_in_the_order_of_tables():
    assert choose_memories("") == ["traditional", "medoid", "prototypes-32", "prototypes-16"]
    assert choose_memories("prototypes-16,medoid") == ["medoid", "prototypes-16"]
