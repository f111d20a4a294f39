"""Makes tracks files, unless they are up to date."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from protomark.geometry.colmap import find_model
from protomark.progress import Progress, silent
from protomark.tracks import database
from protomark.tracks.augmentation import METHOD, add_augmentations
from protomark.tracks.extract import TracksOptions, extract, find_sequence, provenance
from protomark.tracks.file import Tracks
from protomark.tracks.summary import summarise


@dataclass(frozen=True)
class TracksInput:
    """What to make tracks from.

    Attributes:
        folder: a sequence, with images/ and a COLMAP model in sparse/ or sparse/0/.
        images: folder of the images, if it is another one.
        model: folder of the COLMAP model, if it is another one.
        database: a COLMAP database with binary descriptors, which are read in place of the images.
    """

    folder: Path
    images: Path | None = None
    model: Path | None = None
    database: Path | None = None

    @property
    def name(self) -> str:
        """Name of the sequence."""
        return self.folder.resolve().name


@dataclass(frozen=True)
class TracksFile:
    """A tracks file that was made, or was up to date.

    Attributes:
        path: the file.
        tracks: its content.
        skipped: whether it was up to date: made from the same input with the same options.
    """

    path: Path
    tracks: Tracks
    skipped: bool

    def as_dict(self) -> dict[str, Any]:
        """As JSON values."""
        facts = {"file": str(self.path), **summarise(self.tracks)}
        facts |= {"seconds": self.tracks.info.get("seconds"), "skipped": self.skipped}
        count = self.tracks.info.get("augmentations")
        return facts | ({"augmentations": count} if count else {})


def make_tracks(
    source: TracksInput,
    options: TracksOptions,
    output: Path,
    *,
    force: bool = False,
    threads: int = 1,
    progress: Progress = silent,
) -> TracksFile:
    """Make the tracks of a sequence and save them as NAME.DESCRIPTOR.safetensors.

    Args:
        source: what to make them from.
        options: how to make them.
        output: folder of the file, created if it does not exist.
        force: whether to make the file anew even if it is up to date.
        threads: threads for detection and matching.
        progress: called with each stage.

    Raises:
        FileNotFoundError, ValueError: an input is missing or broken, or yields no landmark.
    """
    path = output / f"{source.name}.{options.descriptor}.safetensors"
    if source.database is not None:
        if not source.folder.is_dir():
            raise FileNotFoundError(f"{source.folder}: no such folder")
        model = source.model or find_model(source.folder)
        if not model.is_dir():
            raise FileNotFoundError(f"{model}: no such folder of a COLMAP model")
        inputs = (source.database, model, options.descriptor)
        made_from = partial(database.provenance, *inputs)
        make = partial(database.tracks_from_database, *inputs, source.name)
    else:
        sequence = find_sequence(source.folder, source.images, source.model)
        made_from = partial(provenance, sequence, options)
        make = partial(extract, sequence, options, threads, progress)
    return _make_unless_current(path, made_from, make, force)


def make_augmented_tracks(
    plain: TracksFile,
    images: Path,
    count: int,
    *,
    force: bool = False,
    threads: int = 1,
    progress: Progress = silent,
) -> TracksFile:
    """Add augmented copies of each keyframe, and save NAME.DESCRIPTOR.augmented.safetensors.

    Args:
        plain: tracks that were made from images.
        images: folder of these images.
        count: copies of each keyframe.
        force: whether to make the file anew even if it is up to date.
        threads: keyframes to work on at a time.
        progress: called with each keyframe.
    """
    made_from: dict[str, Any] = {"augmentations": count, "augmentation_method": METHOD}
    made_from |= {key: plain.tracks.info.get(key) for key in ("method", "options", "input")}
    make = partial(add_augmentations, plain.tracks, images, count, threads, progress)
    return _make_unless_current(augmented_path(plain.path), lambda: made_from, make, force)


def augmented_path(plain: Path) -> Path:
    """The path of augmented tracks: toy.freak.augmented.safetensors for toy.freak.safetensors."""
    return plain.with_name(f"{plain.stem}.augmented.safetensors")


def _make_unless_current(
    path: Path, made_from: Callable[[], dict[str, Any]], make: Callable[[], Tracks], force: bool
) -> TracksFile:
    """Make and save tracks unless the file holds tracks that were made from the same."""
    existing = None if force else _load(path)
    if existing and all(existing.info.get(k) == v for k, v in made_from().items()):
        return TracksFile(path, existing, skipped=True)
    begin = time.perf_counter()
    tracks = make()
    tracks.info["seconds"] = round(time.perf_counter() - begin, 1)
    path.parent.mkdir(parents=True, exist_ok=True)
    tracks.save(path)
    return TracksFile(path, tracks, skipped=False)


def _load(path: Path) -> Tracks | None:
    try:
        return Tracks.load(path)
    except (ValueError, OSError):
        return None
