"""What workers do: read a source, count, encode a piece, write a shard."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.distributed.folder import Folder, shown
from protomark.distributed.plan import BUCKET, Source, segments_of
from protomark.distributed.tracks_file import BLOCK, TracksFile
from protomark.extras import optional
from protomark.features.upright import SUFFIX, upright_descriptors
from protomark.maps import sources
from protomark.maps.open import open_learning_map
from protomark.maps.seal import SealRequest, seal_map
from protomark.maps.shards import Shard, describe_file, describe_shard

# Parts that a shard's task asks for at a time.
_FETCHED = 8
WORK = ".build"  # what a build that was cut leaves in the output folder, for --resume
Ids = NDArray[np.int64]
# Of one piece: where each segment begins in (rows,) ids and (rows, dim) codes.
Part = tuple[Ids, Ids, NDArray[np.int8]]


@dataclass(frozen=True)
class Work:
    """What a task took."""

    observations: int
    seconds: float
    bytes_moved: int  # handed over by way of Ray's object store
    retries: int


def worker_version() -> str:
    """The release of Protomark on a worker."""
    return pm.__version__


def open_source(
    source: sources.Source | str, digest: str, output: Folder, descriptor: str | None
) -> Source:
    """Look at a source; all but tracks are read whole, and kept as tracks beside the output."""
    if isinstance(source, str):
        url, name = source, source.rsplit("/", 1)[-1]
    else:
        url, name = str(source.path), source.name
        if source.kind != "tracks":
            kept = f"{WORK}/{digest}.safetensors"
            if output.size(kept) is None:
                (tracks,) = sources.read_sources([source], descriptor)
                with output.workspace(WORK) as folder:
                    tracks.save(folder / f"{digest}.new.safetensors")
                    output.publish(folder / f"{digest}.new.safetensors", kept)
            url = output.url_of(kept)
    file = TracksFile(url)
    count = file.rows("landmark_ids")
    ends = [int(file.read("landmark_ids", i, i + 1)[0]) for i in (0, count - 1) if count]
    fields = file.fields
    info = {**fields["info"], "source": sources.source_of_tracks(fields["info"])}
    return Source(
        name=name,
        shown=shown(source) if isinstance(source, str) else str(source.path),
        digest=digest,
        url=url,
        keyframes=len(fields["keyframe_names"]),
        keypoints=file.rows("keypoints"),
        landmarks=count,
        ids=(ends[0], ends[1]) if ends else (0, -1),
        descriptor=fields["descriptor"],
        input=fields["input"],
        descriptor_bytes=file.descriptor_bytes,
        info=info,
        cameras=list(dict.fromkeys(fields["cameras"].values())),
    )


@dataclass(frozen=True)
class Counted:
    """How often landmarks of a source are observed."""

    observations: int
    highest: int  # observations of a landmark
    short: int  # observed landmarks with fewer observations than the limit, should that be above 1
    firsts: Ids  # for each bucket of landmarks, the first id
    costs: Ids  # and the prototypes that they have at most


def count(url: str, start: int, stop: int, limit: int, most: int) -> Counted:
    """Count the observations of landmarks `start` to `stop` of a source.

    Args:
        url: its tracks file.
        start: the first of its landmarks, a multiple of `BUCKET`.
        stop: the first after them.
        limit: fewest observations of a landmark.
        most: prototypes of a landmark at most.
    """
    file = TracksFile(url)
    ids = file.read("landmark_ids", start, stop)
    after = file.read("landmark_ids", start + len(ids), start + len(ids) + 1)
    if (np.diff(np.concatenate([ids, after])) <= 0).any() or (len(ids) and ids[0] < 0):
        raise ValueError(f"{shown(url)}: landmark_ids are not ascending from 0 on")
    counts = np.zeros(len(ids), np.uint32)
    total = 0
    for begin in range(0, file.rows("landmark_of_keypoint"), BLOCK):
        labels = file.read("landmark_of_keypoint", begin, begin + BLOCK)
        labels = labels[labels != -1]
        labels = labels[labels >= ids[0]] if start else labels
        labels = labels[labels < after[0]] if len(after) else labels
        np.add.at(counts, _rows_of(labels, ids, url), 1)
        total += len(labels)
    steps = np.arange(0, len(ids), BUCKET)
    return Counted(
        total,
        int(counts.max(initial=0)),
        int(((counts > 0) & (counts < limit)).sum()),
        ids[steps],
        np.add.reduceat(np.minimum(counts, most), steps).astype(np.int64),
    )


def _rows_of(labels: Ids, ids: Ids, url: str) -> Ids:
    """Rows of landmarks in ascending ids."""
    if len(ids) and ids[-1] - ids[0] == len(ids) - 1:
        rows = labels - ids[0]
        known = (rows >= 0) & (rows < len(ids))
    else:
        rows = np.searchsorted(ids, labels)
        known = rows < len(ids)
        known[known] = ids[rows[known]] == labels[known]
    if not known.all():
        raise ValueError(
            f"{shown(url)}: landmark_of_keypoint names a landmark that landmark_ids lacks"
        )
    return rows


@lru_cache(maxsize=1)
def _encoder(content: bytes) -> pm.Encoder:
    with tempfile.NamedTemporaryFile(suffix=".pme") as file:
        file.write(content)
        file.flush()
        return pm.Encoder.load(file.name)


def encode_piece(
    source: Source,
    start: int,
    stop: int,
    boundaries: Sequence[int],
    groups: int,
    encoder: bytes,
    dim: int,
) -> list[Any]:
    """Encode the observations of keypoints `start` to `stop`, by the shard that they go to.

    Args:
        source: where they are.
        start: the first keypoint.
        stop: the first after them.
        boundaries: id in the source at which each segment but the first begins.
        groups: objects to hand segments over in.
        encoder: the content of its file.
        dim: numbers of a code.

    Returns:
        The work, and for each group of segments its part, None if it is empty.
    """
    began = time.perf_counter()
    file, network = TracksFile(source.url), _encoder(encoder)
    labels = file.read("landmark_of_keypoint", start, stop)
    rows = np.flatnonzero(labels >= 0)
    segment = np.searchsorted(boundaries, labels[rows], "right")
    order = np.argsort(segment, kind="stable")
    rows, segment = rows[order], segment[order]
    descriptors = file.read("descriptors", start, stop)[rows]
    if network.descriptor.endswith(SUFFIX) and not source.descriptor.endswith(SUFFIX):
        angles, sizes = (file.read(name, start, stop)[rows] for name in ("angles", "sizes"))
        descriptors = upright_descriptors(descriptors, angles, sizes)
    codes = network.encode(descriptors, dim)
    ids = labels[rows] + source.shift
    starts = np.searchsorted(segment, np.arange(len(boundaries) + 2))
    parts: list[Part | None] = []
    for group in range(groups):
        first, last = segments_of(group, groups, len(boundaries) + 1)
        a, b = starts[first], starts[last]
        offsets = starts[first : last + 1] - a
        parts.append((offsets, ids[a:b], codes[a:b]) if b > a else None)
    moved = ids.nbytes + codes.nbytes
    return [Work(len(ids), time.perf_counter() - began, moved, _attempts()), *parts]


@dataclass(frozen=True)
class Input:
    """What a shard takes from a source."""

    source: Source
    start: int  # of its landmarks
    stop: int
    segment: int  # number of the segment in its group's parts
    parts: list[Any]  # references to the parts of all pieces, in order


def write_shard(
    recipe: str,
    inputs: Sequence[Input],
    metadata: dict[str, str],
    encoder: bytes,
    dim: int,
    appearance_bits: int,
    seal: bool,
    cell_size: float | None,
    output: Folder,
) -> tuple[list[Shard], Work]:
    """Sum the codes of a shard's landmarks, source by source and piece by piece, and write it.

    With `cell_size` the shard is divided by space, and parts are written for `join_cell`.
    """
    began = time.perf_counter()
    scene = pm.PrototypeMap(_encoder(encoder), dim, appearance_bits)
    total = 0
    for one in inputs:
        file = TracksFile(one.source.url)
        known = file.read("landmark_ids", one.start, one.stop)
        counts = np.zeros(len(known), np.uint32)
        for offsets, ids, codes in _fetched(one.parts):
            mine = slice(int(offsets[one.segment]), int(offsets[one.segment + 1]))
            scene.add_codes(ids[mine], codes[mine])
            rows = _rows_of(ids[mine] - one.source.shift, known, one.source.url)
            np.add.at(counts, rows, 1)
        total += int(counts.sum())
        seen = counts > 0
        kept = counts >= max(one.source.limit, 1)
        scene.remove(known[seen & ~kept] + one.source.shift)
        positions = file.read("landmark_positions", one.start, one.stop)[kept]
        if not np.isfinite(positions).all():
            raise ValueError(f"{one.source.shown}: landmark_positions contains NaN or infinity")
        scene.set_positions(known[kept] + one.source.shift, positions)
    shards: list[Shard] = []
    with output.workspace(WORK) as folder:
        if not len(scene):
            pass
        elif cell_size is not None:
            for cell, part in scene.split_by_space(cell_size).items():
                name = "nowhere" if cell is None else "_".join(map(str, cell))
                path = folder / f"{recipe}.{name}.pmk"
                part.save(path)
                saved = replace(describe_file(path), name=f"{WORK}/{path.name}")
                output.publish(path, saved.name)
                shards.append(describe_shard(name, part, saved))
        else:
            scene.metadata = metadata
            path = folder / f"{recipe}.pmk"
            shards.append(_saved(str(scene.ids[0]), scene, path, seal, output))
    output.write(f"{WORK}/{recipe}.json", json.dumps([asdict(one) for one in shards]).encode())
    return shards, Work(total, time.perf_counter() - began, 0, _attempts())


def join_cell(
    cell: str, names: Sequence[str], metadata: dict[str, str], seal: bool, output: Folder
) -> tuple[Shard, Work]:
    """Join the parts of a cube of space, which have no landmark in common."""
    began = time.perf_counter()
    with output.workspace(WORK) as folder:
        scene = open_learning_map(output.fetch(names[0], folder))
        for name in names[1:]:
            scene.merge_map(open_learning_map(output.fetch(name, folder)))
        scene.metadata = metadata
        shard = _saved(cell, scene, folder / f"{cell}.new.pmk", seal, output)
    return shard, Work(0, time.perf_counter() - began, 0, _attempts())


def _saved(label: str, scene: pm.PrototypeMap, path: Path, seal: bool, output: Folder) -> Shard:
    """Write the files of a shard, named by its place and what is in it."""
    scene.save(path)
    learning, sealed = describe_file(path), None
    name = f"shard-{label}-{learning.identity[:8]}"
    if seal:
        sealed_to = path.with_suffix(".sealed.pmk")
        seal_map(scene, sealed_to, SealRequest())
        sealed = replace(describe_file(sealed_to), name=f"{name}.sealed.pmk")
        output.publish(sealed_to, sealed.name)
    learning = replace(learning, name=f"{name}.pmk")
    output.publish(path, learning.name)
    return describe_shard(name, scene, learning, sealed)


def _fetched(parts: Sequence[Any]) -> Iterator[Part]:
    ray = optional("ray")
    for begin in range(0, len(parts), _FETCHED):
        yield from (p for p in ray.get(list(parts[begin : begin + _FETCHED])) if p is not None)


def _attempts() -> int:
    """How often Ray has tried this task before."""
    with suppress(AttributeError):  # no public name
        worker = optional("ray._private.worker").global_worker.core_worker
        return int(worker.get_current_task_attempt_number())
    return 0
