"""Makes tracks files, unless they are up to date."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from protomark.files import only_writer
from protomark.progress import Progress, silent
from protomark.tracks import database
from protomark.tracks.augmentation import METHOD, add_augmentations
from protomark.tracks.extract import SequenceFolder, TracksOptions, extract, provenance
from protomark.tracks.file import Tracks, sequence_name
from protomark.tracks.importers import read_source
from protomark.tracks.summary import summarise


@dataclass(frozen=True)
class TracksFile:
    """A tracks file that was made, or was up to date."""

    path: Path  # the file
    tracks: Tracks  # its content
    skipped: bool  # whether it was up to date: made from the same input with the same options

    def as_dict(self) -> dict[str, Any]:
        """As JSON values."""
        facts = {"file": str(self.path), **summarise(self.tracks)}
        facts |= {"seconds": self.tracks.info.get("seconds"), "skipped": self.skipped}
        count = self.tracks.info.get("augmentations")
        return facts | ({"augmentations": count} if count else {})


def make_tracks(
    sequence: SequenceFolder,
    options: TracksOptions,
    output: Path,
    force: bool = False,
    threads: int = 1,
    progress: Progress = silent,
) -> TracksFile:
    """Make the tracks of a sequence and save them as NAME.DESCRIPTOR.safetensors.

    `force` makes a file anew even if it is up to date. The folder `output` need not exist.
    """
    path = output / f"{sequence.name}.{options.descriptor}.safetensors"
    if sequence.database is not None:
        inputs = (sequence.database, sequence.model, options.descriptor)
        made_from = partial(database.provenance, *inputs)
        make = partial(database.tracks_from_database, *inputs, sequence.name)
    else:
        made_from = partial(provenance, sequence, options)
        make = partial(extract, sequence, options, threads, progress)
    return _make_unless_current(path, made_from, make, force)


def import_tracks(path: Path, output: Path) -> TracksFile:
    """Save the map of another program as NAME.DESCRIPTOR.safetensors."""
    begin = time.perf_counter()
    tracks = read_source(path)
    tracks.info["sequence"] = sequence_name(path.resolve())
    tracks.info["seconds"] = round(time.perf_counter() - begin, 1)
    file = output / f"{tracks.info['sequence']}.{tracks.descriptor}.safetensors"
    with only_writer(output, file.name):
        tracks.save(file)
    return TracksFile(file, tracks, skipped=False)


def make_augmented_tracks(
    plain: TracksFile,
    images: Path,
    count: int,
    force: bool = False,
    threads: int = 1,
    progress: Progress = silent,
) -> TracksFile:
    """Add `count` copies of each keyframe, and save NAME.DESCRIPTOR.augmented.safetensors."""
    made_from: dict[str, Any] = {"augmentations": count, "augmentation_method": METHOD}
    made_from |= {key: plain.tracks.info.get(key) for key in ("method", "options", "input")}
    make = partial(add_augmentations, plain.tracks, images, count, threads, progress)
    path = plain.path.with_name(f"{plain.path.stem}.augmented.safetensors")
    return _make_unless_current(path, lambda: made_from, make, force)


def _make_unless_current(
    path: Path, made_from: Callable[[], dict[str, Any]], make: Callable[[], Tracks], force: bool
) -> TracksFile:
    """Make and save tracks unless the file holds tracks that were made from the same."""
    with suppress(ValueError, OSError):
        existing = Tracks.load(path)
        if not force and all(existing.info.get(k) == v for k, v in made_from().items()):
            return TracksFile(path, existing, skipped=True)
    with only_writer(path.parent, path.name):
        begin = time.perf_counter()
        tracks = make()
        tracks.info["seconds"] = round(time.perf_counter() - begin, 1)
        tracks.save(path)
    return TracksFile(path, tracks, skipped=False)
