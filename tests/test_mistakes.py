"""Mistakes of newcomers: each is named in a sentence that says what to do, before any work."""

from __future__ import annotations

import lzma
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import protomark as pm
from conftest import protomark, random_descriptors
from protomark import sample
from protomark.cli import app
from protomark.exporters import export
from protomark.mapping.aligning import Target, align_scene
from protomark.mapping.merging_maps import merge_folders

ATLAS = Path(__file__).parent / "data" / "orbslam3" / "two_maps.osa.xz"


@pytest.fixture
def folder(encoder: pm.Encoder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in: a scene's folder, its map, images, and maps of other programs."""
    monkeypatch.chdir(tmp_path)
    scene = pm.PrototypeMap(encoder)
    scene.add(np.arange(20), random_descriptors(20))
    scene.set_positions(scene.ids, np.arange(60.0).reshape(20, 3))
    for name in ("kitchen", "hall", "photos"):
        (tmp_path / name).mkdir()
    scene.save(tmp_path / "kitchen" / "scene.pmk")
    shutil.copy(tmp_path / "kitchen" / "scene.pmk", "m.pmk")
    scene.seal("sealed.pmk")
    (tmp_path / "photos" / "1.png").write_bytes(b"")
    (tmp_path / "run.bag").write_bytes(b"#ROSBAG V2.0")
    (tmp_path / "atlas.osa").write_bytes(lzma.decompress(ATLAS.read_bytes()))
    export(sample.path(), tmp_path / "data" / "kapture", "kapture")
    return tmp_path


@pytest.mark.parametrize(
    ("command", "message"),
    [
        *(
            (
                command,
                "atlas.osa is a map of ORB-SLAM3, which `protomark build atlas.osa -o scene.pmk`",
            )
            for command in (
                "info atlas.osa",
                "seal atlas.osa -o s.pmk",
                "crop atlas.osa --near 0,0,0,1 -o s.pmk",
                "merge m.pmk atlas.osa -o s.pmk",
                "split atlas.osa --parts 2 -o parts",
                "localize atlas.osa photos",
            )
        ),
        (
            "export atlas.osa --to ply -o s.ply",
            "atlas.osa holds 2 maps, each in coordinates of its own",
        ),
        ("evaluate atlas.osa", "ORB-SLAM3, which `protomark tracks atlas.osa -o tracks` reads"),
        (
            "info data/kapture",
            "data/kapture is a map of kapture, which `protomark build data/kapture",
        ),
        *(
            (command, "data holds a map of kapture in kapture/: name that")
            for command in ("info data", "export data --to ply -o s.ply", "localize data photos")
        ),
        ("build data -o s.pmk", "data holds a map of kapture in kapture/: name that"),
        ("tracks data -o t", "data holds a map of kapture in kapture/: name that"),
        ("map atlas.osa -o s", "ORB-SLAM3, which `protomark build atlas.osa -o scene.pmk` reads"),
        ("build . -o s.pmk", ". holds a map of ORB-SLAM3 in atlas.osa: name that"),
        ("build kitchen -o s.pmk", "kitchen is what Protomark wrote already"),
        ("build run.bag -o s.pmk", "run.bag is a recording, which `protomark map` reads"),
        ("info m.pmk --json atlas.osa", "--json atlas.osa exists and is no JSON: name another"),
        ("tracks atlas.osa -d freak -o t", "--descriptor is for images, which are not read"),
        ("tracks atlas.osa --partners 9 -o t", "--partners is for images, which are not read"),
        ("merge m.pmk kitchen -o s.pmk --renumber --fixed-scale", "--fixed-scale for others"),
        ("localize photos kitchen", "kitchen is a map: name it first, and then the images"),
        ("localize photos/1.png m.pmk", "m.pmk is a map: name it first, and then the images"),
        ("localize m.pmk photos -o kitchen", "kitchen is the folder of a map: name another"),
        ("localize m.pmk photos --recall 0.9", "m.pmk has no index: `protomark seal` makes a map"),
        ("split m.pmk --cell-size -1 -o parts", "--cell-size -1 is not above 0"),
        ("map photos -o s --window 0", "--window 0: it must be at least 2"),
        ("tracks photos -o t --min-length 0", "--min-length 0: it must be at least 2"),
        ("localize m.pmk photos --topic /a", "no ROS bag (.bag, .mcap, .db3) is among the images"),
        ("localize m.pmk photos --prior-degrees 9", "are of --priors, which is missing"),
        ("merge m.pmk kitchen -o s.pmk --no-seal", "--no-seal is for folders"),
        ("map photos --into kitchen --force", "--force makes a map anew: leave out --resume and"),
    ],
)
def test_a_sentence_says_what_to_do(command: str, message: str, folder: Path) -> None:
    before = sorted(path.name for path in folder.rglob("*"))
    with pytest.raises((ValueError, OSError)) as caught:
        app(shlex.split(command), standalone_mode=False)
    assert message in str(caught.value)
    assert sorted(path.name for path in folder.rglob("*")) == before


def test_maps_that_are_replaced_are_named(folder: Path, capsys: Any) -> None:
    for command, replaced in (
        (f"build {sample.path()} -o m.pmk --no-seal", ["m.pmk"]),
        (f"build {sample.path()} -o m.pmk", ["m.pmk"]),
        (f"build {sample.path()} -o m.pmk", ["m.pmk", "m.sealed.pmk"]),
        ("seal m.pmk -o sealed.pmk", ["sealed.pmk"]),
        ("crop m.pmk --near 0,0,0,100 -o kitchen/scene.pmk", ["kitchen/scene.pmk"]),
        ("merge m.pmk kitchen -o s.pmk", []),
        ("merge m.pmk kitchen -o s.pmk", ["s.pmk"]),
        ("export m.pmk --to ply -o s.ply", []),
        ("export m.pmk --to ply -o s.ply", ["s.ply"]),
    ):
        app(shlex.split(command), standalone_mode=False)
        said = capsys.readouterr().err
        assert [f"{name} exists and will be replaced" for name in replaced] == [
            line for line in said.splitlines() if "exists" in line
        ]
    for expected in (False, True):
        app(shlex.split("split m.pmk --parts 2 -o parts"), standalone_mode=False)
        assert (
            "2 files were replaced, such as parts/m.0.pmk" in capsys.readouterr().err
        ) == expected


def test_what_is_refused_is_not_said_to_be_replaced(folder: Path) -> None:
    (folder / "s.ply").touch()
    (folder / "file").touch()
    for command, message in (
        ("merge kitchen m.pmk -o kitchen/scene.pmk", "is an input of this command"),
        ("crop kitchen --near 0,0,0,100 -o kitchen/scene.pmk", "is an input of this command"),
        ("seal kitchen -o m.pmk", "m.pmk is a learning map"),
        ("export s.ply --to ply -o s.ply", "is an input of this command"),
        ("export kitchen --to colmap -o file", "file is not a folder"),
    ):
        done = protomark(*shlex.split(command))
        assert done.returncode == 1
        assert message in done.stderr
        assert "will be replaced" not in done.stderr


def test_the_current_folder_is_not_replaced(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The shell would stay in the old one."""
    tracks = sample.path()
    for inside, call in (
        ("kitchen", lambda here: align_scene(here, Target(scale=2))),
        ("hall", lambda here: merge_folders([folder / "kitchen", folder / "photos"], here)),
        ("hall", lambda here: export(tracks, here, "kapture")),
        ("hall", lambda here: export(tracks, here, "colmap")),
    ):
        monkeypatch.chdir(folder / inside)
        if inside == "hall":
            shutil.copy(folder / "m.pmk", folder / "photos" / "scene.pmk")
        for here in (Path("."), folder / inside):
            with pytest.raises(ValueError, match="is the folder you are in, and is replaced"):
                call(here)
