"""Which tracks files there are, and what each is used for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from protomark.cli.terminal import note
from protomark.tracks.file import sequence_name
from protomark_bench.paper.scale import Scale

# Role -> the project's own sequences, and those of them that the smallest scale uses.
ROLES = {
    "training": ("hololens", "desk_rpy", "viking", "conch", "seneca"),
    "validation": ("caliterra",),
    "test": ("toy", "kitchen", "castle", "kitti07"),
}
SMALL = {"viking", "conch", "seneca", "caliterra", "toy", "castle"}
_OPTIONS = {"training": "--train", "validation": "--validation", "test": "--test"}
_SUFFIX = ".safetensors"


def find(data: Sequence[Path], descriptor: str) -> dict[str, Path]:
    """Name of the sequence -> its tracks file, of files and of folders of them.

    Raises:
        FileNotFoundError: something is missing, or holds no tracks.
        ValueError: two files are of the same sequence.
    """
    files = []
    for path in data:
        if path.is_dir():
            inside = sorted(path.glob(f"*.{descriptor}{_SUFFIX}"))
            if not inside:
                raise FileNotFoundError(
                    f"{path}: holds no *.{descriptor}{_SUFFIX}; make some with `protomark tracks`"
                )
            files += inside
        elif path.is_file():
            files.append(path)
        else:
            raise FileNotFoundError(f"{path}: no such tracks file, and no such folder")
    found: dict[str, Path] = {}
    for file in files:
        other = found.setdefault(sequence_name(file), file)
        if other.resolve() != file.resolve():
            raise ValueError(
                f"{file}: {other} is of the same sequence {sequence_name(file)}; give one of them"
            )
    return found


def assign(
    found: dict[str, Path], scale: Scale, given: dict[str, Sequence[str]]
) -> dict[str, list[str]]:
    """Role -> names of its sequences: those that the user gave it, else the project's own.

    Args:
        found: name -> tracks file.
        scale: a small one uses fewer of the project's own sequences.
        given: role -> names that the user wants in it.

    Raises:
        ValueError: a name is missing or in two roles, or a role is left empty.
    """
    chosen: dict[str, list[str]] = {}
    elsewhere = [name for names in given.values() for name in names]
    for name in elsewhere:
        if name not in found:
            raise ValueError(
                f"no sequence is named {name}: there are {', '.join(sorted(found)) or 'none'}"
            )
        if elsewhere.count(name) > 1:
            raise ValueError(f"{name} is given twice: a sequence has one role")
    for role, own in ROLES.items():
        usual = [
            name
            for name in own
            if name in found and name not in elsewhere and (not scale.small or name in SMALL)
        ]
        chosen[role] = list(given.get(role) or usual)
        if not chosen[role]:
            raise ValueError(
                f"no {role} sequence among {', '.join(sorted(found))}: name one with "
                f"{_OPTIONS[role]} NAME"
            )
    unused = sorted(set(found) - {name for names in chosen.values() for name in names})
    if unused:
        note(f"left out, as they have no role at this scale: {', '.join(unused)}")
    return chosen
