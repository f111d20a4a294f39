"""The command line: help, build, info, and errors in one sentence."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from importlib.metadata import requires
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from packaging.requirements import Requirement
from rich.console import Console

import protomark as pm
from conftest import balanced_encoder, program, protomark, random_descriptors, random_layers
from protomark import sample
from protomark.cli import terminal
from protomark.geometry.camera import Camera
from protomark.maps.build import build_map
from protomark.tracks.file import Tracks


@pytest.fixture
def tracks() -> Tracks:
    """4 keyframes of 5 keypoints; landmark i is keypoint i, the last keypoint has none."""
    rng = np.random.default_rng(0)
    return Tracks(
        descriptor="test",
        cameras={1: Camera("SIMPLE_PINHOLE", 64, 48, (50.0, 32.0, 24.0))},
        keyframe_names=[f"{i}.jpg" for i in range(4)],
        keyframe_camera=np.ones(4, np.int32),
        cam_from_world=np.tile(np.eye(3, 4), (4, 1, 1)),
        offsets=np.arange(0, 21, 5),
        keypoints=rng.uniform(0, 48, (20, 2)).astype(np.float32),
        sizes=np.ones(20, np.float32),
        angles=np.zeros(20, np.float32),
        responses=np.ones(20, np.float32),
        octaves=np.zeros(20, np.int32),
        descriptors=random_descriptors(20),
        landmark_of_keypoint=np.tile([0, 1, 2, 7, -1], 4),
        landmark_ids=np.array([0, 1, 2, 7]),
        landmark_positions=rng.normal(size=(4, 3)),
    )


@pytest.fixture
def model(encoder: pm.Encoder, tmp_path: Path) -> Path:
    encoder.save(tmp_path / "tiny.pme")
    return tmp_path / "tiny.pme"


def test_help_lists_the_commands() -> None:
    done = protomark("--help")
    assert done.returncode == 0
    for command in (
        *("demo", "tracks", "map", "build", "merge", "split", "info", "localize", "train"),
        *("calibrate", "evaluate"),
    ):
        assert command in done.stdout
        assert protomark(command, "--help").returncode == 0
    assert protomark("--version").stdout.strip() == f"protomark {pm.__version__}"


def test_releases_of_typer_that_fail_are_excluded() -> None:
    """With 0.12 every command fails, with 0.13 to 0.15 and click 8.2 every --help."""
    bounds = [Requirement(text) for text in requires("protomark") or []]
    [typer] = [bound.specifier for bound in bounds if bound.name == "typer"]
    assert not [*typer.filter(["0.12.0", "0.12.5", "0.13.0", "0.15.0", "0.15.4"])]
    assert "0.16.0" in typer


def test_other_distributions_add_commands(tmp_path: Path) -> None:
    info = tmp_path / "extra-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: extra\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[protomark.commands]\ngreet = extra:greet\nbroken = no_such_module:f\ninfo = extra:greet\n"
    )
    (tmp_path / "extra.py").write_text(
        "def greet(name: str) -> None:\n"
        "    'Says hello.'\n"
        "    if name == 'nobody': raise ValueError('nobody is there')\n"
        "    print('hello', name)\n"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(tmp_path))
        assert program("greet", "you").stdout == "hello you\n"
        assert program("greet", "nobody").stderr == "error: nobody is there\n"
        assert "Says hello." in program("greet", "--help").stdout
        # The package's own command of the same name goes first.
        assert "Describe what a file holds" in program("info", "--help").stdout
        listed = program("--help")
        assert "Says hello." in listed.stdout
        broken = program("broken")
    assert (broken.returncode, broken.stderr) == (
        1,
        "error: the command broken of another distribution cannot be loaded: No module named "
        "'no_such_module'\n",
    )


def test_starting_imports_nothing_heavy() -> None:
    script = (
        "import sys, protomark, protomark.cli\n"
        "heavy = {'torch', 'cv2', 'pycolmap', 'matplotlib', 'poselib', 'safetensors'}\n"
        "sys.exit(', '.join(heavy & set(sys.modules)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_build_and_info(tracks: Tracks, model: Path, tmp_path: Path) -> None:
    tracks.save(tmp_path / "t.safetensors")
    scene = tmp_path / "scene.pmk"
    done = protomark(
        "build", tmp_path / "t.safetensors", "-o", scene, "--encoder", model, "--dim", 5
    )
    assert done.returncode == 0, done.stderr
    built = pm.open(scene)
    np.testing.assert_array_equal(built.ids, [0, 1, 2, 7])
    np.testing.assert_array_equal(built.counts(built.ids), [4, 4, 4, 4])
    np.testing.assert_array_equal(built.positions(built.ids), tracks.landmark_positions)
    rows = tracks.landmark_of_keypoint == 7
    codes = built.encoder.encode(tracks.descriptors[rows], dim=5)
    np.testing.assert_array_equal(built.prototypes([7])[0], codes.astype(np.float32).mean(0))

    done = protomark("info", scene, "--verify", "--json", tmp_path / "facts.json")
    assert done.returncode == 0, done.stderr
    facts = json.loads((tmp_path / "facts.json").read_text())
    assert (facts["kind"], facts["landmarks"], facts["observations"]) == ("learning map", 4, 16)
    assert facts["count_histogram"] == [0, 0, 0, 0, 4]
    assert "learning map" in done.stdout
    assert protomark("info", model).returncode == 0
    assert protomark("info", tmp_path / "t.safetensors").returncode == 0

    sealed = pm.open(tmp_path / "scene.sealed.pmk")
    assert isinstance(sealed, pm.SealedMap)
    assert sealed.metadata["cameras"] == f"1 {tracks.cameras[1]}\n"
    done = protomark(
        "build", tmp_path / "t.safetensors", "-o", scene, "--encoder", model, "--no-seal"
    )
    assert done.returncode == 0, done.stderr


def test_seal_to_a_size(tracks: Tracks, model: Path, tmp_path: Path) -> None:
    balanced_encoder().save(model)
    tracks.save(tmp_path / "t.safetensors")
    scene, sealed, facts_file = tmp_path / "s.pmk", tmp_path / "out.pmk", tmp_path / "facts.json"
    build = ("build", tmp_path / "t.safetensors", "-o", scene, "--encoder", model, "--no-seal")
    assert protomark(*build).returncode == 0
    assert not (tmp_path / "s.sealed.pmk").exists()

    def facts_of(*options: object) -> dict[str, Any]:
        done = protomark("seal", scene, "-o", sealed, "--json", facts_file, *options)
        assert done.returncode == 0, done.stderr
        return dict(json.loads(facts_file.read_text()))

    # 12 dimensions in 6 words, and ids, which are 0, 1, 2 and 7: a block of 16 bytes and
    # 8 bytes for all four.
    facts = facts_of("--bytes", 6)
    assert (facts["words"], facts["bytes_per_landmark_for_matching"]) == (6, 6 + 24 / 4)
    assert (facts["position_bits"], facts["landmarks"], facts["chosen_by"]) == (16, 4, None)
    learning = pm.open(scene)
    assert learning.prototype_count > len(learning)
    assert facts_of("--bytes", 0)["prototypes"] == learning.prototype_count
    facts = facts_of("--landmarks", 2, "--index", "yes", "--position-bits", 32)
    assert (facts["landmarks"], facts["chosen_by"]) == (2, "space")
    assert (facts["position_bits"], facts["nlist"]) == (32, 1)
    assert facts_of("--no-positions")["position_bits"] is None
    for options, message in (
        (["--bytes", 1], "--bytes must be at least 2"),
        (["--position-bits", 5], "--position-bits must be 32, 16 or 0"),
        (["--megabytes", "nan"], "--megabytes nan is not above 0"),
        (["--landmarks", 5], "5 landmarks cannot be kept: the map has 4"),
        (["--megabytes", 0.001], "0.001 MB are too few: 4 landmarks and the encoder take 0.0"),
    ):
        done = protomark("seal", scene, "-o", sealed, *options)
        assert (done.returncode, message in done.stderr) == (1, True), done.stderr
    before = scene.read_bytes()
    shutil.copy(scene, other := tmp_path / "other.pmk")
    done = protomark("seal", scene, "-o", other)
    assert "other.pmk is a learning map" in done.stderr
    assert other.read_bytes() == scene.read_bytes() == before
    done = protomark("seal", sealed, "-o", tmp_path / "again.pmk")
    assert "is a sealed map, which keeps no sums" in done.stderr


def test_megabytes_keep_the_landmarks_that_cover_the_images(tmp_path: Path) -> None:
    sealed = tmp_path / "small.pmk"
    done = protomark("seal", sample.path(), "-o", sealed, "--megabytes", 0.5)
    assert done.returncode == 0, done.stderr
    assert "landmarks were kept, those that cover the images best" in done.stderr
    assert 0.99 * 0.5e6 <= sealed.stat().st_size <= 0.5e6
    tracks = sample.load()
    kept = pm.open(sealed).ids
    anyhow = np.random.default_rng(0).choice(tracks.landmark_ids, len(kept), replace=False)
    fewest = []
    for ids in (kept, anyhow):
        rows = np.isin(tracks.landmark_of_keypoint, ids)
        fewest.append(np.bincount(tracks.keyframe_of_keypoint[rows], minlength=85).min())
    assert fewest[0] > 2 * fewest[1]


def test_no_command_writes_over_its_input(tracks: Tracks, model: Path, tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "images"):
        folder.mkdir(exist_ok=True)
    t, m, link = tmp_path / "t.safetensors", tmp_path / "m.pmk", tmp_path / "link"
    tracks.save(t)
    assert protomark("build", t, "-o", m, "--encoder", model).returncode == 0
    link.symlink_to(t)
    before = {path: path.read_bytes() for path in (t, m, model)}
    for arguments in (
        ("build", t, "-o", t, "--encoder", model),
        ("build", t, "-o", f"{tmp_path}/./t.safetensors", "--encoder", model),
        ("build", link, "-o", t, "--encoder", model),
        ("build", t, "-o", model, "--encoder", model),
        ("info", m, "--json", m),
        ("info", t, "--json", t),
        ("evaluate", t, "--json", t),
        ("evaluate", t, "--encoder", model, "--markdown", model),
        ("calibrate", model, t, "-o", t),
        ("localize", m, tmp_path / "images", "--json", m),
        ("seal", m, "-o", m),
        ("merge", m, t, "-o", tmp_path / "o.pmk", "--json", m),
        ("split", m, "-o", tmp_path / "parts", "--parts", 2, "--json", m),
        ("train", t, "-o", t),
    ):
        done = protomark(*arguments)
        said = "is no JSON" if "--json" in arguments else "is an input of this command"
        assert (done.returncode, said in done.stderr) == (1, True), (arguments, done.stderr)
    both = tmp_path / "both.pmk"
    done = protomark("build", t, "-o", both, "--encoder", model, "--json", both)
    assert "would be written twice" in done.stderr
    done = protomark("info", t, "--json", "/dev/null")
    assert "/dev/null is not a regular file" in done.stderr
    assert {path: path.read_bytes() for path in before} == before


def row(output: str, name: str) -> str:
    """The line of the printed facts that starts with `name`."""
    return next(line for line in output.splitlines() if line.startswith(name))


def test_notes_of_an_encoder_cannot_pass_for_facts(tmp_path: Path) -> None:
    notes = dict.fromkeys(["kind", "bits", "bytes", "checksums", "notes"], "tracks")
    notes |= {"identity": "0" * 64, "match_calibration_data": "a\nkind  tracks"}
    layers = random_layers([64, 12])
    encoder = pm.Encoder(layers, [12], name="tiny", descriptor="test", scale=0.02, notes=notes)
    scene = pm.PrototypeMap(encoder)
    scene.add([1], random_descriptors(1))
    model, facts_file = tmp_path / "t.pme", tmp_path / "facts.json"
    encoder.save(model)
    scene.save(tmp_path / "t.pmk")
    done = protomark("info", model, "--verify", "--json", facts_file)
    assert done.returncode == 0, done.stderr
    facts = json.loads(facts_file.read_text())
    assert (facts["kind"], facts["checksums"], facts["name"]) == ("encoder", "all right", "tiny")
    assert (facts["identity"], facts["bits"]) == (encoder.identity, 64)
    assert (facts["bytes"], facts["notes"]) == (model.stat().st_size, notes)
    names = ["kind", "name", "descriptor", "numbers", "trained on", "licence", "bytes", "checksums"]
    assert [re.split("  +", line)[0] for line in done.stdout.splitlines()] == names

    done = protomark("info", tmp_path / "t.pmk", "--json", facts_file)
    facts = json.loads(facts_file.read_text())["encoder"]
    assert (facts["identity"], facts["notes"]) == (encoder.identity, notes)
    assert "tiny, for test of 64 bits" in row(done.stdout, "encoder")


def test_info_is_what_a_newcomer_asks_for(encoder: pm.Encoder, tmp_path: Path) -> None:
    scene, path = pm.PrototypeMap(encoder), tmp_path / "scene.pmk"
    scene.add(np.arange(200) % 100, random_descriptors(200))
    scene.set_positions(scene.ids, np.arange(300.0).reshape(100, 3))
    scene.metadata = {"frame": "ENU, metres\nkind  tracks"}
    scene.build_index(4)
    for made in (scene.seal, scene.save):
        made(path)
        done = protomark("info", path, "--verify", "--json", tmp_path / "facts.json")
        assert done.returncode == 0, done.stderr
        facts = json.loads((tmp_path / "facts.json").read_text())
        rows = dict(re.split("  +", line.strip(), maxsplit=1) for line in done.stdout.splitlines())
        assert rows["kind"] == facts["kind"]
        assert rows["landmarks"] == "100, each with a prototype of 12 numbers"
        assert rows["bytes"].startswith(f"{path.stat().st_size:,}: ")
        assert rows["index"] == "4 inverted lists"
        assert rows["positions"].startswith("of 100 landmarks")
        assert rows["extent"] == "(0, 1, 2) to (297, 298, 299)"
        assert rows["metadata: frame"] == "ENU, metres; kind  tracks"
        assert rows["checksums"] == "all right"
        assert len(rows) == (9 if facts["kind"] == "sealed map" else 10)


def test_verifying_tracks_says_that_they_have_no_checksums(tracks: Tracks, tmp_path: Path) -> None:
    tracks.save(tmp_path / "t.safetensors")
    done = protomark("info", tmp_path / "t.safetensors", "--verify")
    assert done.returncode == 0, done.stderr
    assert "none in a tracks file" in row(done.stdout, "checksums")


def test_landmarks_seen_too_rarely_are_left_out(tracks: Tracks, encoder: pm.Encoder) -> None:
    tracks.landmark_of_keypoint[5:] = np.where(
        tracks.landmark_of_keypoint[5:] == 7, -1, tracks.landmark_of_keypoint[5:]
    )
    np.testing.assert_array_equal(build_map(tracks, encoder).ids, [0, 1, 2])
    with pytest.raises(ValueError, match="no landmark has 5 observations"):
        build_map(tracks, encoder, min_observations=5)


def test_errors_are_one_sentence(tracks: Tracks, model: Path, tmp_path: Path) -> None:
    tracks.descriptor = "other"
    tracks.save(tmp_path / "t.safetensors")
    (tmp_path / "text").write_text("no map")
    (tmp_path / "cut.safetensors").write_bytes((tmp_path / "t.safetensors").read_bytes()[:-9])
    output = tmp_path / "scene.pmk"
    calls = [
        (["build", tmp_path / "t.safetensors", "-o", output, "--encoder", model], "is for test"),
        (["build", tmp_path / "t.safetensors", "-o", output], "neither a model file nor"),
        (["build", tmp_path / "none.safetensors", "-o", output], "no such tracks file"),
        (["build", tmp_path / "cut.safetensors", "-o", output], "not a tracks file, or a broken"),
        (["info", tmp_path / "text"], "not a Protomark file"),
        (["info", tmp_path / "none"], "No such file"),
    ]
    for arguments, message in calls:
        done = protomark(*arguments)
        assert done.returncode == 1
        assert done.stderr.startswith("error: ")
        assert message in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1
        assert not output.exists()


def test_errors_show_no_control_characters(tmp_path: Path) -> None:
    for name, shown in (
        (b"\x1b]0;title\x07.pmk", r"\x1b]0;title\x07"),
        (b"\xff.pmk", r"\udcff.pmk"),
    ):
        result = protomark("info", tmp_path / os.fsdecode(name))
        assert result.returncode == 1
        assert result.stderr.startswith("error: ")
        assert shown in result.stderr
        assert result.stderr.rstrip("\n").isprintable()


def test_a_folder_of_map_is_a_map(encoder: pm.Encoder, tmp_path: Path) -> None:
    folder, empty = tmp_path / "kitchen", tmp_path / "empty"
    folder.mkdir(), empty.mkdir()
    scene = pm.PrototypeMap(encoder)
    scene.add(np.arange(6), np.arange(6 * 8, dtype=np.uint8).reshape(6, 8))
    scene.save(folder / "scene.pmk")
    assert isinstance(pm.open(folder), pm.PrototypeMap)
    assert protomark("info", "--verify", folder).stdout.count("learning map") == 1
    assert protomark("split", folder, "--parts", 2, "-o", tmp_path).returncode == 0
    assert len(pm.open(tmp_path / "scene.1.pmk")) == 3
    part = tmp_path / "scene.0.pmk"
    merged = protomark("merge", folder, part, "-o", tmp_path / "both.pmk")
    assert merged.returncode == 0, merged.stderr
    assert "input" in protomark("merge", folder, part, "-o", folder / "scene.pmk").stderr

    # What ships comes first, but the map that learns takes observations.
    scene.seal(folder / "scene.sealed.pmk")
    assert isinstance(pm.open(folder), pm.SealedMap)
    assert isinstance(pm.open(folder, journal=True), pm.PrototypeMap)
    for command in (["info", empty], ["split", empty, "--parts", 2, "-o", tmp_path]):
        assert "empty holds no scene.pmk" in protomark(*command).stderr


def test_output_that_the_terminal_cannot_show(
    tracks: Tracks, model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracks.save(tmp_path / "t.safetensors")
    monkeypatch.setenv("PYTHONIOENCODING", "ascii")
    done = program(
        "build", tmp_path / "t.safetensors", "-o", tmp_path / "m.pmk", "--encoder", model
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "per landmark 1" in done.stdout


def test_arguments_that_cannot_be_meant(tracks: Tracks, model: Path, tmp_path: Path) -> None:
    tracks.save(tmp_path / "t.safetensors")
    build = ("build", tmp_path / "t.safetensors", "-o", tmp_path / "x.pmk", "--encoder", model)
    for arguments, message in (
        (("map", "", "-o", tmp_path / "x"), "an argument is empty"),
        ((*build, "--dim", -1), "--dim -1: encoder 'tiny' has codes of 5, 12 dimensions"),
        ((*build, "--dim", 2**70), f"--dim {2**70}: encoder 'tiny' has codes of 5, 12 dimensions"),
    ):
        done = protomark(*arguments)
        assert done.returncode == 1
        assert message in done.stderr
        assert done.stderr.count("\n") == 1
    assert not (tmp_path / "x").exists()


def test_sigterm_is_ctrl_c_even_after_pycolmap_was_imported() -> None:
    script = (
        "import os, signal\n"
        "signal.signal(signal.SIGTERM, signal.default_int_handler)\n"
        "import protomark.geometry.colmap\n"
        "try: os.kill(os.getpid(), signal.SIGTERM)\n"
        "except KeyboardInterrupt: print('stopped')\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("stopped\n", "")


@pytest.mark.parametrize("module", ["protomark._core", "typer", "protomark.cli.train"])
@pytest.mark.parametrize("command", ["/usr/bin/protomark", "-m", "other"])
def test_ctrl_c_during_imports_ends_without_a_traceback(module: str, command: str) -> None:
    program = f"""
import os, runpy, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # tests in the background ignore it
class Finder:
    def find_spec(name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder)
sys.argv, sys.orig_argv = [{command!r}], ["python", {command!r}, "protomark"]
runpy.run_module("protomark", run_name="__main__")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    if command == "other":  # a program that imports the package handles Ctrl-C itself
        assert "KeyboardInterrupt" in done.stderr
    else:
        assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_progress_of_a_redirected_command_is_plain_lines(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr(terminal.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(terminal, "error_console", Console(stderr=True))
    with terminal.progress_bar("plane: ") as report:
        for step in range(12):
            now[0] += 2
            report("match, 3 registered", step, 20 if step < 6 else 0)
    assert capsys.readouterr().err.splitlines() == [
        "plane: match, 3 registered: 4 of 20",
        "plane: match, 3 registered: 9",
    ]
