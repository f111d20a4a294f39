from __future__ import annotations

from pathlib import Path

import pytest

from protomark_bench.paper.scale import SCALES
from protomark_bench.paper.sequences import ROLES, assign, find

NONE = {"training": [], "validation": [], "test": []}


def make(folder, *names):
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def there(*names):
    return {name: Path(name) for name in names}


def test_finds_files_and_folders_of_them(tmp_path):
    make(tmp_path, "t/a.freak.safetensors", "t/a.orb.safetensors", "d.freak.safetensors")
    found = find([tmp_path / "t", tmp_path / "d.freak.safetensors"], "freak")
    assert {name: path.relative_to(tmp_path).as_posix() for name, path in found.items()} == {
        "a": "t/a.freak.safetensors",
        "d": "d.freak.safetensors",
    }


def test_what_holds_no_sequence_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere: no such tracks file"):
        find([tmp_path / "nowhere"], "freak")
    with pytest.raises(FileNotFoundError, match=r"holds no \*\.freak\.safetensors"):
        find([tmp_path], "freak")
    make(tmp_path, "x/a.freak.safetensors", "y/a.freak.safetensors")
    with pytest.raises(ValueError, match="sequence a: give one"):
        find([tmp_path / "x", tmp_path / "y"], "freak")


def test_own_sequences_have_roles_and_small_takes_some(capsys):
    every = there(*(name for role in ROLES.values() for name in role), "mine")
    assert assign(every, SCALES["full"], NONE) == {k: list(v) for k, v in ROLES.items()}
    assert "without a role at this scale: mine" in capsys.readouterr().err
    assert assign(every, SCALES["small"], NONE) == {
        "training": ["viking", "conch", "seneca"],
        "validation": ["caliterra"],
        "test": ["toy", "castle"],
    }


def test_given_roles_replace_own_ones():
    found = there("hololens", "viking", "conch", "toy", "mine")
    given = {"training": [], "validation": ["viking"], "test": ["mine"]}
    assert assign(found, SCALES["medium"], given) == {
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
