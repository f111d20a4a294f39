from __future__ import annotations

from pathlib import Path

import pytest

from protomark_bench.paper.scale import SCALES
from protomark_bench.paper.sequences import KNOWN, FoundSequence, assign, find

NONE = {"training": [], "validation": [], "test": []}


def make(folder, *names):
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if name.endswith("/images"):
            path.mkdir(parents=True)
        else:
            path.touch()


def there(*names):
    return {name: FoundSequence(name, Path(name)) for name in names}


def names(roles):
    return {role: [s.name for s in found] for role, found in roles.items()}


def test_finds_files_folders_of_files_and_folders_of_images(tmp_path):
    make(
        tmp_path,
        "tracks/a.freak.safetensors",
        "tracks/a.orb.safetensors",
        "data/a/images",
        "data/b/images",
        "other/c/images",
        "d.freak.safetensors",
    )
    where = ["data", "tracks", "other/c", "d.freak.safetensors"]
    found = find([tmp_path / name for name in where], "freak")
    assert {name: one.path.relative_to(tmp_path).as_posix() for name, one in found.items()} == {
        "a": "tracks/a.freak.safetensors",
        "b": "data/b",
        "c": "other/c",
        "d": "d.freak.safetensors",
    }


def test_looks_in_known_places(tmp_path, monkeypatch, capsys):
    here = tmp_path / "project"
    here.mkdir()
    monkeypatch.chdir(here)
    with pytest.raises(FileNotFoundError, match=r"no sequences in data, .*protomark tracks"):
        find([], "freak")
    make(tmp_path, "data/toy/images")
    assert list(find([], "freak")) == ["toy"]
    assert "taking the sequences in ../data" in capsys.readouterr().err


def test_what_holds_no_sequence_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere: no such tracks file"):
        find([tmp_path / "nowhere"], "freak")
    with pytest.raises(FileNotFoundError, match=r"holds no \*\.freak\.safetensors"):
        find([tmp_path], "freak")
    make(tmp_path, "x/a.freak.safetensors", "y/a.freak.safetensors")
    with pytest.raises(ValueError, match="same sequence a; give one"):
        find([tmp_path / "x", tmp_path / "y"], "freak")


def test_known_sequences_have_roles_and_small_takes_the_quick_ones(capsys):
    every = there(*(name for role in KNOWN.values() for name in role), "mine")
    assert names(assign(every, SCALES["full"], NONE)) == {k: list(v) for k, v in KNOWN.items()}
    assert "left out, as they have no role at this scale: mine" in capsys.readouterr().err
    assert names(assign(every, SCALES["small"], NONE)) == {
        "training": ["viking", "conch", "seneca"],
        "validation": ["caliterra"],
        "test": ["toy", "castle"],
    }


def test_given_roles_replace_known_ones():
    found = there("hololens", "viking", "conch", "toy", "mine")
    given = {"training": [], "validation": ["viking"], "test": ["mine"]}
    assert names(assign(found, SCALES["medium"], given)) == {
        "training": ["hololens", "conch"],
        "validation": ["viking"],
        "test": ["mine"],
    }


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"validation": ["b"]}, "no test sequence among a, b, viking: name one with --test"),
        ({"test": ["b"]}, "no validation sequence among .*--validation NAME"),
        ({"test": ["z"]}, "no sequence is named z: there are a, b, viking"),
        ({"test": ["a"], "validation": ["a"]}, "a is given twice"),
        ({"test": ["viking"], "validation": ["a"]}, "no training sequence .*--train NAME"),
    ],
)
def test_roles_that_cannot_be(given, message):
    with pytest.raises(ValueError, match=message):
        assign(there("a", "b", "viking"), SCALES["small"], {**NONE, **given})
