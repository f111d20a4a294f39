"""Which sequences there are, what each is used for, and their tracks files."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from protomark.console import progress_bar, progress_console
from protomark_bench.paper.scale import Scale

ROLES = ("training", "validation", "test")
_OPTIONS = {"training": "--train", "validation": "--validation", "test": "--test"}

# The sequences that the project knows, and those of them whose tracks are made in a minute.
KNOWN = {
    "training": ("hololens", "desk_rpy", "viking", "conch", "seneca"),
    "validation": ("caliterra",),
    "test": ("toy", "kitchen", "castle", "kitti07"),
}
QUICK = {"viking", "conch", "seneca", "caliterra", "toy", "castle"}

# Where sequences are looked for if none are named.
_PLACES = ("data", "../data", "../shared/data")
_SUFFIX = ".safetensors"


@dataclass(frozen=True)
class FoundSequence:
    """One sequence: a tracks file, or a folder with images to make one from."""

    name: str
    path: Path

    @property
    def has_tracks(self) -> bool:
        """Whether `path` is a tracks file."""
        return self.path.is_file()


def find(data: Sequence[Path], descriptor: str) -> dict[str, FoundSequence]:
    """Name -> sequence, of tracks files, folders of them, and folders of images and models.

    None given: the sequences in data/, ../data/ or ../shared/data/, whichever is there first. A
    tracks file goes before a folder of images of the same name.

    Raises:
        FileNotFoundError: something is missing, or holds no sequence.
        ValueError: two tracks files are of the same sequence.
    """
    if not data:
        place = next((p for p in map(Path, _PLACES) if p.is_dir() and _sequences(p)), None)
        if place is None:
            raise FileNotFoundError(
                f"no sequences in {', '.join(_PLACES)}: name tracks files (*.{descriptor}{_SUFFIX},"
                " see `protomark tracks`) or folders that hold images/ and sparse/"
            )
        progress_console.print(f"taking the sequences in {place}", highlight=False)
        data = [place]
    found: dict[str, FoundSequence] = {}
    for path in data:
        for one in _in(path, descriptor):
            other = found.get(one.name)
            if other and other.has_tracks and one.has_tracks and other.path != one.path:
                raise ValueError(
                    f"{one.path}: {other.path} is of the same sequence {one.name}; give one of them"
                )
            if other is None or one.has_tracks:
                found[one.name] = one
    return found


def _in(path: Path, descriptor: str) -> list[FoundSequence]:
    if path.is_file():
        return [FoundSequence(path.name.split(".")[0], path)]
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: no such tracks file, and no such folder")
    if (path / "images").is_dir():
        return [FoundSequence(path.resolve().name, path)]
    files = sorted(path.glob(f"*.{descriptor}{_SUFFIX}"))
    found = [FoundSequence(file.name.split(".")[0], file) for file in files]
    found += [FoundSequence(folder.name, folder) for folder in _sequences(path)]
    if not found:
        raise FileNotFoundError(
            f"{path}: holds no *.{descriptor}{_SUFFIX} and no folder with images/ and sparse/"
        )
    return found


def _sequences(folder: Path) -> list[Path]:
    return sorted(path.parent for path in folder.glob("*/images") if path.is_dir())


def assign(
    found: dict[str, FoundSequence], scale: Scale, given: dict[str, Sequence[str]]
) -> dict[str, list[FoundSequence]]:
    """Role -> its sequences, from the names of those that the project knows.

    Args:
        found: the sequences there are.
        scale: at a quick one only the quick ones of the known sequences take part.
        given: role -> names that the user wants in it; they replace those that are known.

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
    for role in ROLES:
        known = [
            name
            for name in KNOWN[role]
            if name in found and name not in elsewhere and (not scale.quick or name in QUICK)
        ]
        chosen[role] = list(given.get(role) or known)
        if not chosen[role]:
            raise ValueError(
                f"no {role} sequence among {', '.join(sorted(found))}: name one with "
                f"{_OPTIONS[role]} NAME"
            )
    used = {name for names in chosen.values() for name in names}
    unused = sorted(set(found) - used)
    if unused:
        progress_console.print(
            f"left out, as they have no role at this scale: {', '.join(unused)}",
            highlight=False,
            soft_wrap=True,
        )
    return {role: [found[name] for name in names] for role, names in chosen.items()}


def tracks_file(sequence: FoundSequence, descriptor: str, folder: Path, threads: int) -> Path:
    """The sequence's tracks file; made into `folder` from its images if need be.

    A file that was made from the same input with the same settings is used again.
    """
    if sequence.has_tracks:
        return sequence.path
    from protomark.tracks.extract import Settings, extract, find_source, fingerprint, is_done

    settings = Settings(descriptor)
    source = find_source(sequence.path)
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{sequence.name}.{descriptor}{_SUFFIX}"
    if is_done(target, settings, fingerprint(source)):
        return target
    begin = time.perf_counter()
    with progress_bar() as bar:
        task = bar.add_task(sequence.name, total=None)

        def progress(stage: str, done: int, total: int) -> None:
            text = f"tracks of {sequence.name}: {stage}"
            bar.update(task, description=text, completed=done, total=total)

        tracks = extract(source, settings, threads, progress)
    tracks.info["seconds"] = round(time.perf_counter() - begin, 1)
    tracks.save(target)
    progress_console.print(
        f"tracks of {sequence.name}: {len(tracks.landmark_ids)} landmarks, "
        f"{len(tracks.observations)} observations, {tracks.info['seconds']:.0f} s",
        highlight=False,
    )
    return target
