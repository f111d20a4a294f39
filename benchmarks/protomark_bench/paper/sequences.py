"""Finds tracks files and assigns their roles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from protomark.cli.terminal import note
from protomark.tracks.file import sequence_name
from protomark_bench.paper.scale import Scale

# The project's sequences by role, and those of them that the smallest scale uses.
ROLES = {
    "training": ("hololens", "desk_rpy", "viking", "conch", "seneca"),
    "validation": ("caliterra",),
    "test": ("toy", "kitchen", "castle", "kitti07"),
}
SMALL = {"viking", "conch", "seneca", "caliterra", "toy", "castle"}
_OPTIONS = {"training": "--train", "validation": "--validation", "test": "--test"}
_SUFFIX = ".safetensors"


def find(data: Sequence[Path], descriptor: str) -> dict[str, Path]:
    """Tracks files by the name of their sequence, from files and folders of files.

    Raises:
        FileNotFoundError: a file or folder is missing, or a folder holds no tracks.
        ValueError: two files are of the same sequence.
    """
    files = []
    for path in data:
        if path.is_dir():
            inside = sorted(path.glob(f"*.{descriptor}{_SUFFIX}"))
            if not inside:
                raise FileNotFoundError(
                    f"{path} holds no *.{descriptor}{_SUFFIX}: make them with `protomark tracks`"
                )
            files += inside
        elif path.is_file():
            files.append(path)
        else:
            raise FileNotFoundError(f"{path}: no such tracks file or folder")
    found: dict[str, Path] = {}
    for file in files:
        other = found.setdefault(sequence_name(file), file)
        if other.resolve() != file.resolve():
            raise ValueError(
                f"{file} and {other} are of the sequence {sequence_name(file)}: give one of them"
            )
    return found


def assign(
    found: dict[str, Path], scale: Scale, given: dict[str, Sequence[str]]
) -> dict[str, list[str]]:
    """Names of sequences by role: those that the user gave, else the project's.

    Args:
        found: tracks files by name.
        scale: a small scale uses fewer of the project's sequences.
        given: names by the role that the user gave them.

    Raises:
        ValueError: a name is missing or has two roles, or a role has no sequence.
    """
    chosen: dict[str, list[str]] = {}
    assigned = [name for names in given.values() for name in names]
    for name in assigned:
        if name not in found:
            raise ValueError(
                f"no sequence is named {name}: there are {', '.join(sorted(found)) or 'none'}"
            )
        if assigned.count(name) > 1:
            raise ValueError(f"{name} is given twice: a sequence has one role")
    for role, names in ROLES.items():
        default = [
            name
            for name in names
            if name in found and name not in assigned and (not scale.small or name in SMALL)
        ]
        chosen[role] = list(given.get(role) or default)
        if not chosen[role]:
            raise ValueError(
                f"no {role} sequence among {', '.join(sorted(found))}: name one with "
                f"{_OPTIONS[role]} NAME"
            )
    unused = sorted(set(found) - {name for names in chosen.values() for name in names})
    if unused:
        note(f"without a role at this scale: {', '.join(unused)}")
    return chosen
