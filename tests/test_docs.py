"""The documentation: its code blocks run, its commands exist, its links lead somewhere.

The blocks of a page run from top to bottom in one folder and one namespace, which hold a small map
of the sample (`workspace`, `names`). Commands that take long are only parsed.
"""

from __future__ import annotations

import json
import lzma
import re
import shlex
import shutil
import subprocess
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import protomark as pm

pytest.importorskip("safetensors")
typer = pytest.importorskip("typer")

ROOT = Path(__file__).parents[1]
GUIDES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PAGES = [
    *GUIDES,
    *sorted((ROOT / "docs").glob("*/*.md")),
    *(ROOT / name for name in ("CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")),
    ROOT / "benchmarks" / "README.md",
]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`protomark ([^`]+)`")
# Quick on the sample; all other commands are only parsed.
QUICK = {"align", "build", "crop", "export", "info", "localize", "merge", "seal", "split"}
# Whose map is small enough to be made, of rendered images.
MAPPED = "small-map.md"
# Commands of protomark-bench, which need not be installed here.
BENCH = {"bench", "evaluate-mapping", "reproduce"}
# What the fragments of C++ may use.
PREAMBLE = """#include <cmath>
#include <memory>
#include <optional>
#include <span>
#include <vector>
#include "protomark/protomark.h"
namespace pm = protomark;
struct Pose {};
struct Pixel {};
std::optional<Pose> pnp(const std::vector<pm::Position>&, const std::vector<Pixel>&);
"""
# What a header needs that not every machine has.
OPTIONAL = {
    "protomark/opencv.h": Path("/usr/include/opencv4"),
    "protomark/eigen.h": Path("/usr/include/eigen3"),
}


def blocks(page: Path, *languages: str) -> list[tuple[str, str]]:
    """Language and text of the fenced blocks in these languages."""
    found = BLOCK.findall(page.read_text(encoding="utf-8"))
    return [(language, text) for language, text in found if language in languages]


def commands(text: str) -> list[list[str]]:
    """The arguments of each line of a shell that begins with `protomark`."""
    lines = text.replace("\\\n", " ").splitlines()
    split = (shlex.split(re.sub(r"^\w+=\S+ ", "", line.strip()), comments=True) for line in lines)
    return [words[1:] for words in split if words[:1] == ["protomark"]]


def parse(arguments: list[str], *allowed: str) -> None:
    """Parse a command as `protomark` does, which raises errors, but for those that are allowed."""
    from protomark.cli import app

    group = typer.main.get_command(app)
    if not arguments or arguments[0].startswith("-"):
        return
    context = group.make_context("protomark", [], resilient_parsing=True)
    command = group.get_command(context, arguments[0])
    if command is None and arguments[0] in BENCH:
        return
    assert command is not None, f"there is no command {arguments[0]}"
    try:
        command.make_context(arguments[0], arguments[1:])
    except Exception as error:  # Typer may bring a Click of its own
        if type(error).__name__ not in allowed:
            raise


@pytest.fixture(scope="session")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the pages name: maps, tracks, an encoder, an image, cameras, poses."""
    cv2 = pytest.importorskip("cv2")
    from protomark import models, sample
    from protomark.maps.build import build_map

    folder = tmp_path_factory.mktemp("workspace")
    for name in ("toy", "my"):
        shutil.copy(sample.path(), folder / f"{name}.freak.safetensors")
    shutil.copy(Path(models.__file__).parent / "freak.pme", folder)
    scene = build_map(sample.load(), pm.Encoder.load("freak"), 32)
    scene.save(folder / "scene.pmk")
    scene.seal(folder / "scene.sealed.pmk")
    for name, part in zip("ab", scene.split_by_id([2000]), strict=True):
        part.save(folder / f"{name}.pmk")
    hall = pm.PrototypeMap(scene.encoder, scene.dim, scene.appearance_bits)
    hall.merge_map(scene, into=scene.ids[-1] - scene.ids, source=scene.ids)
    hall.set_positions(hall.ids, 2 * hall.positions(hall.ids)[:, [1, 2, 0]])
    hall.save(folder / "hall.pmk")
    for name in ("kitchen", "new"):
        (folder / name).mkdir()
    shutil.copy(folder / "scene.pmk", folder / "kitchen")
    if find_spec("pycolmap"):
        write_foreign_maps(folder)
    noise = np.random.default_rng(0).integers(0, 256, (60, 80, 3)).astype(np.uint8)
    image = cv2.resize(noise, (640, 480), interpolation=cv2.INTER_CUBIC)
    cv2.imwrite(str(folder / "frame.jpg"), image)
    cv2.imwrite(str(folder / "new" / "frame.jpg"), image)
    (folder / "cameras.txt").write_text("1 PINHOLE 640 480 525 525 320 240\n")
    (folder / "rough.txt").write_text("1 1 0 0 0 0 0 0 1 frame.jpg\n\n")
    return folder


def write_foreign_maps(folder: Path) -> None:
    from foreign_scene import orb_tracks
    from protomark.geometry.camera import Camera
    from rtabmap_writer import write_rtabmap
    from stella_writer import write_msg
    from tracks_scene import write_sequence

    tracks = orb_tracks(Camera("PINHOLE", 640, 480, (525.0, 525.0, 320.0, 240.0)))
    data = ROOT / "tests" / "data" / "orbslam3"
    (folder / "atlas.osa").write_bytes(lzma.decompress((data / "two_maps.osa.xz").read_bytes()))
    (folder / "frames").mkdir()
    for path in data.glob("*.jpg"):
        shutil.copy(path, folder / "frames")
    write_msg(folder / "map.msg", tracks)
    write_sequence(folder, count=5)
    write_rtabmap(folder / "rtabmap.db", tracks)


@pytest.fixture
def names(workspace: Path) -> dict[str, Any]:
    """What a page's Python may use without making it."""
    from protomark import sample

    toy = sample.load()
    seen = toy.observations
    frames = [
        np.intersect1d(np.arange(s.start, s.stop), seen) for s in map(toy.keypoints_of, range(3))
    ]
    return {
        "pm": pm,
        "encoder": pm.Encoder.load("freak"),
        "scene": pm.open(workspace / "scene.pmk"),
        "landmark_ids": toy.landmark_of_keypoint[seen],
        "descriptors": toy.descriptors[seen],
        "angles": toy.angles[seen],
        "sizes": toy.sizes[seen],
        "ids": toy.landmark_ids,
        "positions": toy.landmark_positions,
        "frame_descriptors": toy.descriptors[toy.keypoints_of(40)],
        "keyframes": [(toy.landmark_of_keypoint[rows], toy.descriptors[rows]) for rows in frames],
    }


@pytest.mark.parametrize("page", GUIDES, ids=lambda page: page.name)
def test_blocks_run(
    page: Path, names: dict[str, Any], workspace: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    from protomark.cli import app

    folder = tmp_path / "work"
    shutil.copytree(workspace, folder)
    monkeypatch.chdir(folder)
    quick = QUICK
    if page.name.startswith("from-"):
        pytest.importorskip("pycolmap")
    if page.name == "city.md":
        pytest.importorskip("ray")
    if page.name == MAPPED:
        pytest.importorskip("pycolmap")
        from mapping_scene import walk, write_images

        quick = QUICK | {"map"}
        shutil.rmtree("new")
        poses = walk(16)
        write_images(Path("photos"), poses[::2])
        write_images(Path("new"), poses[1::4])
    for language, text in blocks(page, "python", "bash"):
        if language == "python":
            exec(compile(text, f"{page.name}: {text.splitlines()[0]}", "exec"), names)
            continue
        for arguments in commands(text):
            if arguments[0] in quick:
                if arguments[0] == "localize":
                    pytest.importorskip("poselib")
                    pytest.importorskip("pycolmap")
                app(arguments, standalone_mode=False)
    if page.name == MAPPED:
        found = json.loads(Path("found.json").read_text())
        assert found["localized"] == found["images"] == 4


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_parse(page: Path, workspace: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(workspace)
    text = page.read_text(encoding="utf-8")
    outside = BLOCK.sub("", text)
    indented = "\n".join(line for line in outside.splitlines() if line.startswith("    protomark"))
    shells = [text for _, text in blocks(page, "bash", "sh")]
    for arguments in commands("\n".join([*shells, indented])):
        parse(arguments, "Exit")
    for arguments in INLINE.findall(outside):
        incomplete = ("BadOptionUsage", "Exit", "MissingParameter")
        parse(shlex.split(arguments.replace("...", "")), *incomplete)


@pytest.mark.parametrize("page", GUIDES, ids=lambda page: page.name)
def test_cpp_compiles(page: Path, tmp_path: Path) -> None:
    compiler = shutil.which("g++") or shutil.which("clang++")
    found = blocks(page, "cpp")
    if not found:
        return
    if compiler is None:
        pytest.skip("no C++ compiler")
    library = ROOT / "build" / "core" / "libprotomark.a"
    for i, (_, text) in enumerate(found):
        whole = "int main" in text
        source = tmp_path / f"block{i}.cpp"
        source.write_text(text if whole else PREAMBLE + text)
        needed = [folder for header, folder in OPTIONAL.items() if header in text]
        if not all(folder.is_dir() for folder in needed):
            continue
        include = [f"-I{ROOT / 'core' / 'include'}", *(f"-isystem{folder}" for folder in needed)]
        options = ["-std=c++20", "-Wall", *include, str(source)]
        if not (whole and library.is_file()):
            subprocess.run([compiler, "-fsyntax-only", *options], check=True)
            continue
        program = tmp_path / f"block{i}"
        link = [str(library), "-pthread", "-o", str(program)]
        subprocess.run([compiler, *options, *link], check=True)
        model = ROOT / "python" / "protomark" / "models" / "freak.pme"
        subprocess.run([str(program), str(model)], check=True, cwd=tmp_path)


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as MkDocs and GitHub make them."""
    text = BLOCK.sub("", page.read_text(encoding="utf-8"))
    found = set()
    for heading in re.findall(r"^#+ (.+)$", text, re.MULTILINE):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).strip().lower()
        slug = re.sub(r"[^\w\s-]", "", plain)
        found |= {re.sub(r"\s", "-", slug), re.sub(r"[-\s]+", "-", slug)}
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(r"`[^`]*`", "", BLOCK.sub("", page.read_text(encoding="utf-8")))
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page.name}: {target}"
        if anchor and file.suffix == ".md":
            assert anchor in anchors(file), f"{page.name}: {target}"


def test_every_header_is_on_the_page() -> None:
    page = (ROOT / "docs" / "api" / "cpp.md").read_text(encoding="utf-8")
    headers = sorted(path.name for path in (ROOT / "core" / "include" / "protomark").glob("*.h"))
    assert [name for name in headers if f'"{name}"' not in page and name != "protomark.h"] == []


def test_every_section_is_in_the_formats() -> None:
    page = (ROOT / "docs" / "format.md").read_text(encoding="utf-8")
    header = (ROOT / "core" / "src" / "file" / "sections.h").read_text(encoding="utf-8")
    names = re.findall(r'constexpr char k\w+\[\] = "(\w+)"', header)
    assert len(names) > 20
    assert [name for name in names if f"`{name}`" not in page] == []


def test_every_public_name_is_in_the_glossary() -> None:
    page = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
    names = [name for name in pm.__all__ if name[0] != "_"]
    assert [name for name in names if f"`{name}" not in page and f"`pm.{name}" not in page] == []


def test_size_of_the_guides() -> None:
    assert sum(len(page.read_text(encoding="utf-8").split()) for page in GUIDES) <= 20_000
