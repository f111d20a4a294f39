"""Reads what a map is built from: tracks, images or a database with their model, foreign maps."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from protomark.features.images import image_names
from protomark.features.upright import SUFFIX
from protomark.files import natural_key
from protomark.geometry import colmap
from protomark.geometry.camera import Camera
from protomark.maps.info import is_tracks
from protomark.progress import Progress, silent, tracked
from protomark.tracks.database import is_database, stored_descriptor, tracks_from_database
from protomark.tracks.extract import SequenceFolder, TracksOptions, extract, find_sequence
from protomark.tracks.file import Tracks
from protomark.tracks.importers import check_below, file_head, find_importer, read_source
from protomark.tracks.joining import join_tracks, renumbered

_DESCRIPTOR = "freak"  # of images, where neither encoder nor other sources tell

Kind = Literal["tracks", "map", "sequence", "images", "database", "model"]


@dataclass(frozen=True)
class Source:
    """A place, of which observations come from one source."""

    path: Path
    kind: Kind
    # The model of images or of a database.
    model: Path | None = None

    @property
    def name(self) -> str:
        """What it is called, by which sources are ordered."""
        path = self.path.resolve()
        return path.parent.name if path.name == "images" else path.name


def find_sources(paths: Sequence[Path]) -> list[Source]:
    """The sources that paths name, in the order of their names.

    Images and a database come with their COLMAP model: the path before or after theirs.

    Raises:
        FileNotFoundError: there is no such file or folder.
        ValueError: something is no source, named twice, or has no model or nothing else.
    """
    sources: list[Source] = []
    pending: Source | None = None  # lacks its other half
    for path in paths:
        source = Source(path, _kind(path))
        halves = {source.kind, pending.kind} if pending else set()
        if pending and "model" in halves and halves & {"images", "database"}:
            model, other = (source, pending) if source.kind == "model" else (pending, source)
            sources.append(replace(other, model=_model_folder(model.path)))
            pending = None
        elif pending:
            raise _lonely(pending, paths)
        elif source.kind in ("images", "database", "model"):
            pending = source
        else:
            sources.append(source)
    if pending:
        raise _lonely(pending, paths)
    named = [source.path.resolve() for source in sources]
    for source in sources:
        if named.count(source.path.resolve()) > 1:
            raise ValueError(f"{source.path} is named twice: its observations would count twice")
    return sorted(sources, key=lambda s: (natural_key(s.name), str(s.path)))


def _kind(path: Path) -> Kind:
    if is_tracks(path):
        return "tracks"
    if is_database(path, file_head(path)):
        return "database"
    if path.is_dir():
        if _model_folder(path) is not None:
            return "model"
        if (path / "images").is_dir() and (path / "sparse").is_dir():
            return "sequence"
        if find_importer(path) is None and image_names(path):
            return "images"
    return "map"


def _model_folder(path: Path) -> Path | None:
    """The COLMAP model in a folder that is one, such as sparse/, or in its first subfolder."""
    return next((p for p in (path, path / "0") if colmap.is_model(p)), None)


def _lonely(source: Source, paths: Sequence[Path]) -> ValueError:
    for path in paths:
        # What should have been the other half says what it is instead.
        if _kind(path) == "map" and find_importer(path) is None:
            read_source(path)
    if source.kind == "images":
        check_below(source.path)
    lacking = {
        "images": "holds images without poses: name the folder of their COLMAP model after it, or "
        "map them with `protomark map`",
        "database": "is a COLMAP database: name the folder of its model after it",
        "model": "is a COLMAP model: name the folder of its images, or its database, before it",
    }
    return ValueError(f"{source.path} {lacking[source.kind]}")


def read_sources(
    sources: Sequence[Source],
    descriptor: str | None = None,
    threads: int = 1,
    progress: Progress = silent,
) -> list[Tracks]:
    """The observations of each source, whose `info` has a "source".

    Images are described anew.

    Args:
        sources: see `find_sources`.
        descriptor: the descriptor that an encoder takes; None: that of the sources.
        threads: threads to describe images on.
        progress: called with each stage.

    Raises:
        FileNotFoundError, ValueError: a source cannot be read, or they hold different descriptors.
    """
    read: dict[Source, Tracks] = {}
    wanted = f"the encoder is for {descriptor}" if descriptor else ""
    # Those that may be of any descriptor come last.
    order = sorted(sources, key=lambda s: ("map", "tracks").count(s.kind) == 0)
    for source in tracked(order, progress, "read sources"):
        tracks = _read(source, descriptor, threads, progress)
        descriptor = descriptor or tracks.descriptor
        if tracks.descriptor not in (descriptor.removesuffix(SUFFIX), descriptor):
            others = wanted or f"others have {descriptor}"
            raise ValueError(
                f"{source.path} has {tracks.descriptor} descriptors, but {others}: a map holds one "
                "kind, so build a map of each"
            )
        read[source] = tracks
    return [read[source] for source in sources]


def _read(source: Source, descriptor: str | None, threads: int, progress: Progress) -> Tracks:
    plain = descriptor.removesuffix(SUFFIX) if descriptor else None
    if source.kind == "tracks":
        tracks = Tracks.load(source.path)
        tracks.info["source"] = source_of_tracks(tracks.info)
        return tracks
    if source.kind == "map":
        return read_source(source.path)
    if source.kind == "database":
        assert source.model is not None
        chosen = plain or stored_descriptor(source.path)
        return tracks_from_database(
            source.path, source.model, chosen, source.name, observed_only=True
        )
    if source.kind == "images":
        assert source.model is not None
        folder = SequenceFolder(source.name, source.path, source.model)
    else:
        folder = find_sequence(source.path)
    tracks = extract(folder, TracksOptions(plain or _DESCRIPTOR), threads, progress)
    model = {"program": "images and a COLMAP model", "version": "unknown"}
    tracks.info["source"] = {**model, "digest": tracks.info["input"]}
    return tracks


def source_of_tracks(info: dict[str, Any]) -> dict[str, Any]:
    """What the `info` of tracks says of their source."""
    made = {"version": info.get("software", {}).get("protomark", "unknown")}
    made |= {"digest": info["input"]} if "input" in info else {}
    return info.get("source", {"program": "Protomark", **made})


def read_places(
    paths: Sequence[Path],
    descriptor: str | None = None,
    min_observations: int | None = None,
    threads: int = 1,
    progress: Progress = silent,
) -> Tracks:
    """The observations of all sources that paths name, each of which is a place of its own.

    Landmarks keep their ids unless an earlier source, by name, has ids as large: then they follow
    these. `info["sources"]` has facts on each source, `info["detectors"]` its detector.

    Args:
        paths: see `find_sources`.
        descriptor: see `read_sources`.
        min_observations: landmarks with fewer have none; None: 2, or 1 in sources in which no
            landmark has two.
        threads: see `read_sources`.
        progress: see `read_sources`.

    Raises:
        FileNotFoundError, ValueError: see `find_sources` and `read_sources`; or no landmark of a
            source has so many observations, or an id is too large.
    """
    sources = find_sources(paths)
    facts, parts, detectors = [], [], []
    last = -1
    for source, one in zip(
        sources, read_sources(sources, descriptor, threads, progress), strict=True
    ):
        try:
            one = renumbered(one, last)
            kept = _often_seen(one, min_observations)
        except ValueError as error:
            raise ValueError(f"{source.path}: {error}") from None
        last = int(one.landmark_ids[-1])
        parts.append(kept)
        facts.append(_facts(source.name, replace(one, info=kept.info)))
        detectors.append(one.info.get("detector", {}))
    info = {"sources": facts, "detectors": detectors}
    if len(parts) == 1:
        return replace(parts[0], info={**parts[0].info, **info})
    return join_tracks([source.name for source in sources], parts, info)


def _often_seen(tracks: Tracks, min_observations: int | None) -> Tracks:
    rows = tracks.observations
    _, landmark, counts = np.unique(
        tracks.landmark_of_keypoint[rows], return_inverse=True, return_counts=True
    )
    limit = fewest_observations(int(counts.max(initial=0)), min_observations)
    labels = tracks.landmark_of_keypoint.copy()
    labels[rows[counts[landmark] < limit]] = -1
    source = with_dropped(tracks.info["source"], limit, int((counts < limit).sum()))
    return replace(tracks, landmark_of_keypoint=labels, info={**tracks.info, "source": source})


def fewest_observations(highest: int, min_observations: int | None) -> int:
    """How many observations a landmark needs in a source whose landmarks have up to `highest`.

    Raises:
        ValueError: none has so many.
    """
    limit = min(2, highest) if min_observations is None else min_observations
    if highest < max(limit, 1):
        raise ValueError(
            f"no landmark has {max(limit, 1)} observations: give longer tracks or lower "
            "--min-observations"
        )
    return limit


def with_dropped(source: dict[str, Any], limit: int, short: int) -> dict[str, Any]:
    """The `info["source"]` of tracks of which so many landmarks had fewer observations."""
    if not short:
        return source
    text = f"landmarks of fewer observations than {limit}"
    return {**source, "dropped": {**source.get("dropped", {}), text: short}}


def _facts(name: str, tracks: Tracks) -> dict[str, Any]:
    return source_facts(
        name,
        tracks.info,
        {
            "keyframes": len(tracks.keyframe_names),
            "landmarks": len(tracks.landmark_ids),
            "observations": len(tracks.observations),
        },
        tracks.descriptor,
        tracks.cameras.values(),
        tracks.landmark_ids[[0, -1]].tolist(),
    )


def source_facts(
    name: str,
    info: dict[str, Any],
    counts: dict[str, int],
    descriptor: str,
    cameras: Iterable[Camera],
    ids: list[int],
) -> dict[str, Any]:
    """What the metadata of a map say of a source, by the `info` of its tracks."""
    return {
        "name": name,
        **info["source"],
        **counts,
        "descriptor": descriptor,
        "cameras": sorted({f"{c.model} {c.width}x{c.height}" for c in cameras}),
        **({"detector": detector} if (detector := info.get("detector")) else {}),
        "ids": ids,
    }
