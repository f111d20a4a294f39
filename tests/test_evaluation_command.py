"""`protomark evaluate` on synthetic tracks."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import protomark as pm
from conftest import protomark
from evaluation_scene import ring_scene
from protomark.evaluation.protocol import split
from protomark.evaluation.results import MethodResult
from protomark.evaluation.run import encoders_for, learn_moments
from protomark.tracks.file import sequence_name


def evaluate(*arguments: Any) -> subprocess.CompletedProcess[str]:
    return protomark("evaluate", *arguments)


@pytest.fixture
def tracks(tmp_path: Path) -> Path:
    path = tmp_path / "ring.test.safetensors"
    ring_scene().save(path)
    return path


@pytest.fixture
def model(encoder: pm.Encoder, tmp_path: Path) -> Path:
    encoder.save(tmp_path / "tiny.pme")
    return tmp_path / "tiny.pme"


def sequences(path: Path) -> Any:
    """What --json holds of each sequence."""
    return json.loads(path.read_text())["sequences"]


def test_everything_at_once(tracks: Path, model: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.test.safetensors"
    ring_scene(seed=1).save(other)
    out = [tmp_path / "r.json", tmp_path / "r.md", tmp_path / "r.png"]
    done = evaluate(
        tracks, other, "--encoder", model, "--seeds", 2,
        "--json", out[0], "--markdown", out[1], "--plot", out[2],
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for shown in ("ring, TEST, random split: 20", "Protomark, 12", "mean of 2 sequences"):
        assert shown in done.stdout
    results = sequences(out[0])
    assert [r["sequence"] for r in results] == ["ring", "other"]
    figures = {m["name"]: MethodResult(**m) for m in results[0]["methods"]}
    assert len(figures) == 24
    assert all(len(m.precision) == 2 for m in figures.values())
    # What is easy by making: little noise, and the mean takes most of it away.
    assert figures["unaggregated"].summary().precision > 0.95
    assert figures["majority"].summary().precision > figures["random"].summary().precision
    assert figures["mean"].summary().pose_recall == 1
    assert json.loads(out[0].read_text())["sequences"][0]["table"][0]["ratio"] == 1
    assert out[1].read_text().count("#### ") == 3
    assert out[2].read_bytes().startswith(b"\x89PNG")


def test_revisits(tracks: Path, tmp_path: Path) -> None:
    out = [tmp_path / "r.json", tmp_path / "r.md"]
    done = evaluate(
        tracks, "--split", "later", "--seeds", 2, "--methods", "medoid,itq-8",
        "--json", out[0], "--markdown", out[1],
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "ring, TEST, later split" in done.stdout
    assert "ring, TEST, later split" in out[1].read_text()
    (result,) = sequences(out[0])
    parts = [split(ring_scene(), seed, "later") for seed in (0, 1)]
    assert result["split"] == "later"
    assert result["queries"] == np.mean([len(part.query_rows) for part in parts])
    assert result["methods"][0]["frames"] == sum(len(part.query_keyframes) for part in parts)


def test_without_an_encoder_the_others_are_compared(tracks: Path) -> None:
    done = evaluate(tracks, "--seeds", 1, "--pose-frames", 0, "--methods", "medoid, pca")
    assert done.returncode == 0
    assert "no encoder for test" in done.stderr
    assert "Medoid" in done.stdout
    assert "Random" not in done.stdout


def test_precision_is_the_same_in_every_run_and_on_any_threads(
    tracks: Path, tmp_path: Path
) -> None:
    figures = []
    for threads in (1, 2):
        path = tmp_path / f"{threads}.json"
        evaluate(tracks, "--seeds", 1, "--threads", threads, "--json", path)
        figures.append(
            [
                [m[key] for key in ("name", "precision", "found", "right")]
                for m in sequences(path)[0]["methods"]
            ]
        )
    assert figures[0] == figures[1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["none.safetensors"], "none.safetensors: no such tracks file"),
        (["TRACKS", "--methods", "median"], "there is no method 'median'"),
        (["TRACKS", "--encoder", "none"], "none: neither a model file nor a bundled encoder"),
        (["TRACKS", "--plot", "plot.txt"], "plot.txt: name a picture that ends in"),
        (["TRACKS", "--json", "no/such/r.json"], "no/such: no such folder to write r.json to"),
        (["TRACKS", "--json", "."], "is a folder: name a file"),
        (["TRACKS", "--discriminant-from", "none"], "none: no such tracks file"),
        (["MODEL"], "tiny.pme: not a tracks file"),
    ],
)
def test_mistakes_are_one_sentence(
    tracks: Path, model: Path, arguments: list[str], message: str
) -> None:
    names = {"TRACKS": tracks, "MODEL": model}
    done = evaluate(*[names.get(a, a) for a in arguments])
    assert done.returncode == 1
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


def test_discriminants_can_be_learned_from_other_tracks(tracks: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.safetensors"
    ring_scene(seed=1).save(other)
    path = tmp_path / "r.json"
    done = evaluate(
        tracks, "--methods", "discriminant-8", "--seeds", 1,
        "--discriminant-from", other, "--json", path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert sequences(path)[0]["discriminant"] == "other.safetensors"

    together = learn_moments([tracks, other], ring_scene())
    one = learn_moments([tracks], ring_scene())
    assert not np.array_equal(together.within, one.within)
    with pytest.raises(ValueError, match="give tracks of the same descriptor"):
        learn_moments([other], ring_scene(bits=128))


def test_encoders_fit_by_descriptor_and_bits(encoder: pm.Encoder) -> None:
    assert encoders_for(ring_scene(), [encoder], given=True) == [encoder]
    assert encoders_for(ring_scene(bits=128), [encoder], given=True) == []
    # Of those that ship, the one that is named like the descriptor.
    assert encoders_for(ring_scene(), [encoder], given=False) == []


def test_sequence_names() -> None:
    assert sequence_name(Path("a/toy.freak.safetensors")) == "toy"
    assert sequence_name(Path(".hidden")) == ".hidden"
