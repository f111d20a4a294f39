"""`protomark tracks`: results, skipping of finished work, and errors on bad input."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from conftest import program, protomark
from protomark.tracks.file import Tracks
from tracks_scene import PINHOLE, poses, write_model, write_sequence

FAST = ["--max-keypoints", "300", "--threads", "1"]


def run(*arguments: object, command: str = "tracks") -> subprocess.CompletedProcess[str]:
    return protomark(command, *arguments)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sequence(tmp_path_factory.mktemp("scene") / "plane", count=5)


@pytest.fixture
def copy(sequence: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(sequence, tmp_path / "plane"))


def fails(done: subprocess.CompletedProcess[str], *words: str) -> None:
    """Expects one sentence on stderr with these words, exit code 1 and no traceback."""
    assert done.returncode == 1, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    message = done.stderr[done.stderr.index("error:") :].strip()
    assert message.count("\n") == 0, message
    for word in words:
        assert word in message, message


def test_writes_summary_json_and_skips_on_rerun(sequence: Path, tmp_path: Path) -> None:
    out, report = tmp_path / "out", tmp_path / "r.json"
    arguments = [sequence, "-d", "orb", "-d", "freak", "-o", out, "--json", report, *FAST]
    first = run(*arguments)
    assert first.returncode == 0, first.stderr
    names = sorted(p.name for p in out.iterdir())
    assert names == ["plane.freak.safetensors", "plane.orb.safetensors"]
    assert "observations per landmark" in first.stdout
    figures = json.loads(report.read_text())
    assert [f["descriptor"] for f in figures] == ["orb", "freak"]
    tracks = Tracks.load(out / "plane.orb.safetensors")
    assert figures[0]["landmarks"] == len(tracks.landmark_ids) > 50
    assert not any(f["skipped"] for f in figures)

    before = {p: p.stat().st_mtime_ns for p in out.iterdir()}
    again = run(*arguments)
    assert again.returncode == 0
    assert "skipped" in again.stderr
    assert {p: p.stat().st_mtime_ns for p in out.iterdir()} == before
    assert all(f["skipped"] for f in json.loads(report.read_text()))

    other = run(sequence, "-d", "orb", "-o", out, *FAST, "--ratio", "0.7")
    assert other.returncode == 0
    assert "skipped" not in other.stderr
    assert Tracks.load(out / "plane.orb.safetensors").info["options"]["ratio"] == 0.7
    forced = run(sequence, "-d", "orb", "-o", out, *FAST, "--ratio", "0.7", "--force")
    assert "skipped" not in forced.stderr


def test_as_a_program(copy: Path, tmp_path: Path) -> None:
    (copy / "images" / "img2.png").unlink()
    fails(program("tracks", copy, "-o", tmp_path / "out"), "img2.png")


def test_other_layouts(sequence: Path, tmp_path: Path) -> None:
    nested = tmp_path / "nested"
    shutil.copytree(sequence / "images", nested / "images")
    shutil.copytree(sequence / "sparse", nested / "sparse" / "0")
    apart = tmp_path / "apart"
    shutil.copytree(sequence / "images", apart / "photos")
    shutil.copytree(sequence / "sparse", apart / "colmap")
    options = ["-d", "orb", "-o", tmp_path / "out", *FAST]
    assert run(nested, *options).returncode == 0
    given = ["--images", apart / "photos", "--model", apart / "colmap"]
    assert run(apart, *options, *given).returncode == 0
    a, b = (Tracks.load(tmp_path / "out" / f"{n}.orb.safetensors") for n in ("nested", "apart"))
    assert np.array_equal(a.landmark_of_keypoint, b.landmark_of_keypoint)


def test_binary_model_without_points(copy: Path, tmp_path: Path) -> None:
    from protomark.geometry.colmap import read_reconstruction

    model = read_reconstruction(copy / "sparse")
    shutil.rmtree(copy / "sparse")
    (copy / "sparse").mkdir()
    model.write_binary(str(copy / "sparse"))
    (copy / "sparse" / "points3D.bin").unlink()
    assert run(copy, "-d", "orb", "-o", tmp_path / "out", *FAST).returncode == 0


def test_image_without_pose_is_left_out_and_named(copy: Path, tmp_path: Path) -> None:
    names = [f"img{i}.png" for i in (1, 2, 4, 5)]
    shutil.rmtree(copy / "sparse")
    write_model(copy / "sparse", PINHOLE, names, poses(5)[[0, 1, 3, 4]])
    done = run(copy, "-d", "orb", "-o", tmp_path / "out", *FAST)
    assert done.returncode == 0
    assert re.search(r"left out without a pose +img3\.png", done.stdout)
    assert Tracks.load(tmp_path / "out" / "plane.orb.safetensors").keyframe_names == names


def test_image_that_cannot_be_read_is_left_out_and_named(copy: Path, tmp_path: Path) -> None:
    path = copy / "images" / "img3.png"
    path.write_bytes(path.read_bytes()[:-500])
    done = run(copy, "-d", "orb", "-o", tmp_path / "out", *FAST)
    assert done.returncode == 0, done.stderr
    assert re.search(r"left out, cannot be read +img3\.png \(the image is truncated", done.stdout)
    tracks = Tracks.load(tmp_path / "out" / "plane.orb.safetensors")
    assert tracks.keyframe_names == [f"img{i}.png" for i in (1, 2, 4, 5)]
    assert "img3.png" in tracks.info["images_unreadable"]


class TestBadInput:
    @pytest.fixture
    def out(self, tmp_path: Path) -> Path:
        return tmp_path / "out"

    def check(self, folder: Path, out: Path, *words: str, options: list[str] | None = None) -> None:
        fails(run(folder, "-d", "orb", "-o", out, *FAST, *(options or [])), *words)
        assert not out.exists() or not list(out.iterdir()), "something half-written"

    def test_missing_folder(self, tmp_path: Path, out: Path) -> None:
        self.check(tmp_path / "nowhere", out, "nowhere", "no such folder")

    def test_empty_folder(self, tmp_path: Path, out: Path) -> None:
        (tmp_path / "empty" / "images").mkdir(parents=True)
        self.check(tmp_path / "empty", out, "images", "empty")

    def test_no_model(self, copy: Path, out: Path) -> None:
        shutil.rmtree(copy / "sparse")
        self.check(copy, out, "no COLMAP model", "--model")

    def test_missing_image(self, copy: Path, out: Path) -> None:
        (copy / "images" / "img2.png").unlink()
        self.check(copy, out, "img2.png", "missing")

    def test_no_image_can_be_read(self, copy: Path, out: Path) -> None:
        for path in (copy / "images").iterdir():
            path.write_bytes(path.read_bytes()[:-500])
        self.check(copy, out, "5 of 5 images", "img1.png", "truncated")

    def test_image_of_another_size(self, copy: Path, out: Path) -> None:
        import cv2

        cv2.imwrite(str(copy / "images" / "img1.png"), np.zeros((100, 120), np.uint8))
        self.check(copy, out, "img1.png", "120x100", "320x240")

    def test_empty_model_file(self, copy: Path, out: Path) -> None:
        (copy / "sparse" / "images.txt").write_text("")
        self.check(copy, out, "images.txt", "empty")

    def test_truncated_model(self, copy: Path, out: Path) -> None:
        path = copy / "sparse" / "images.txt"
        path.write_text(path.read_text()[:200])
        self.check(copy, out, "sparse", "broken COLMAP model")

    def test_model_of_noise(self, copy: Path, out: Path) -> None:
        rng = np.random.default_rng(0)
        for name in ("cameras", "images", "points3D"):
            (copy / "sparse" / f"{name}.txt").unlink(missing_ok=True)
            (copy / "sparse" / f"{name}.bin").write_bytes(rng.bytes(3000))
        self.check(copy, out, "broken COLMAP model")

    def test_one_pose(self, copy: Path, out: Path) -> None:
        shutil.rmtree(copy / "sparse")
        write_model(copy / "sparse", PINHOLE, ["img1.png"], poses(1))
        self.check(copy, out, "triangulation needs two")

    def test_cameras_at_one_place(self, copy: Path, out: Path) -> None:
        same = np.repeat(poses(5)[:1], 5, axis=0)
        shutil.rmtree(copy / "sparse")
        write_model(copy / "sparse", PINHOLE, [f"img{i}.png" for i in range(1, 6)], same)
        self.check(copy, out, "same position")

    def test_images_of_another_scene(self, copy: Path, out: Path) -> None:
        import cv2

        for i in range(1, 6):
            noise = np.random.default_rng(i).integers(0, 255, (240, 320), dtype=np.uint8)
            cv2.imwrite(str(copy / "images" / f"img{i}.png"), noise)
        self.check(copy, out, "plane", "the poses of these images")

    def test_unknown_descriptor(self, copy: Path, out: Path) -> None:
        self.check(copy, out, "surf", "teblid", options=["-d", "surf"])

    @pytest.mark.parametrize(
        ("option", "value"),
        [("--ratio", "1.5"), ("--max-error", "0"), ("--min-length", "1"), ("--refine-poses", "x")],
    )
    def test_option_out_of_range(self, copy: Path, out: Path, option: str, value: str) -> None:
        self.check(copy, out, option, value, options=[option, value])

    def test_output_is_a_file(self, copy: Path, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        fails(run(copy, "-d", "orb", "-o", tmp_path / "file", *FAST), "file", "-o")

    def test_two_folders_of_one_name(self, copy: Path, tmp_path: Path) -> None:
        other = shutil.copytree(copy, tmp_path / "other" / "plane")
        fails(run(copy, other, "-o", tmp_path / "out", *FAST), "plane", "same file")
