"""Builds a map in shards on a Ray cluster: what `build` does, for more than one machine."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import protomark as pm
from protomark.distributed import plan
from protomark.distributed.cluster import LOCAL, Tasks, connected
from protomark.distributed.folder import Folder, file_system, is_url, shown
from protomark.distributed.job import Job, Request
from protomark.files import MANIFEST, STATE, check_folder, natural_key, only_writer
from protomark.maps import sources as places
from protomark.maps.shards import Manifest, check_manifest
from protomark.progress import Progress, silent

MEMORY = 1000.0  # MB of a worker


def build(
    sources: Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    *,
    ray: str = LOCAL,
    memory: float = MEMORY,
    encoder: pm.Encoder | None = None,
    dim: int | None = None,
    min_observations: int | None = None,
    metadata: Mapping[str, str] | None = None,
    seal: bool = True,
    cell_size: float | None = None,
    resume: bool = False,
    add: bool = False,
    progress: Progress = silent,
    piece: int | None = None,
) -> dict[str, Any]:
    """Build a map in shards of sources on a Ray cluster; `pm.ShardedMap` opens the folder.

    The shards together are the map that `protomark build` makes of these sources, bit for bit, on
    any number of workers and whatever happens to them. The folder holds the version that was there
    before, until the new one is whole.

    Args:
        sources: what `protomark build` takes, or URLs of tracks files, such as
            s3://bucket/a.freak.safetensors. Workers see the same paths.
        output: folder of a disk that all workers share, or URL of one in object storage.
        ray: "local", "auto" or HOST:PORT. Ignored where this process is connected already.
        memory: MB that a worker may take, which decides how large shards are. A source that is not
            a tracks file is read by one worker as a whole.
        encoder: None: the one that ships for the descriptors.
        dim: see `protomark.maps.build.build_map`.
        min_observations: see `protomark.maps.sources.read_places`.
        metadata: further metadata of the map.
        seal: whether to seal each shard.
        cell_size: edge of the cubes of space of which each becomes a shard, in the unit of the
            positions; only of sources that are one place. None: shards are ranges of ids.
        resume: take over the shards that a build with the same arguments finished before it was
            cut.
        add: the sources are further places of the map in the folder, whose shards stay.
        progress: called with each stage.
        piece: keypoints that a task encodes at a time; None: what memory allows. No shard depends
            on it.

    Returns:
        What `protomark info` says of the folder; facts on the sources that were read; and "run":
        seconds, observations, observations per second of a worker, bytes that moved through Ray's
        object store, retries of tasks, and shards that were written and taken over.

    Raises:
        FileNotFoundError, ValueError: see `read_places`; or the folder is none of shards, or
            memory is too little.
        ConnectionError: no cluster answers.
        OSError: a shard cannot be written.
    """
    if memory * 1e6 < plan.MIN_MEMORY:
        raise ValueError(
            f"--memory {memory:g}: a worker needs {plan.MIN_MEMORY / 1e6:g} MB or more"
        )
    if cell_size is not None and not 0 < cell_size < math.inf:
        raise ValueError(f"--cell-size {cell_size:g} is not above 0")
    folder = Folder(str(output))
    request = Request(
        folder,
        dim,
        min_observations,
        dict(metadata or {}),
        seal,
        cell_size,
        int(memory * 1e6),
        resume,
        add,
        piece,
    )
    found = _find_sources([str(source) for source in sources])
    if folder.local is not None:
        check_folder(folder.local)
        if (folder.local / STATE).is_file():
            raise ValueError(f"{folder} is the folder of a map: name another one")
        check_manifest(folder.local)
    base = _base(folder, found) if add else None
    with (
        only_writer(folder.local) if folder.local else nullcontext(),
        connected(ray, request.memory) as cluster,
    ):
        running = Tasks(cluster, request.memory)
        try:
            return Job(cluster, running, request, encoder, base, progress).run(found)
        finally:
            running.cancel()


def _find_sources(names: Sequence[str]) -> list[tuple[places.Source | str, str]]:
    """Sources in the order of their names, each with a digest that changes when it does."""
    local = places.find_sources([Path(name) for name in names if not is_url(name)])
    urls = [name for name in names if is_url(name)]
    for url in urls:
        if not url.endswith(".safetensors"):
            raise ValueError(f"{shown(url)}: only tracks files are read from object storage")
        if urls.count(url) > 1:
            raise ValueError(f"{shown(url)} is named twice: its observations would count twice")
    found: list[tuple[places.Source | str, str]] = [(s, _digest_of(s)) for s in local]
    for url in urls:
        fs, path = file_system(url)
        try:
            info = fs.info(path)
        except FileNotFoundError:
            raise FileNotFoundError(f"{shown(url)}: no such tracks file") from None
        found.append((url, plan.recipe_of([shown(url), {k: str(v) for k, v in info.items()}])))
    return sorted(found, key=lambda s: (natural_key(_name(s[0])), str(s[0])))


def _name(source: places.Source | str) -> str:
    return source.rsplit("/", 1)[-1] if isinstance(source, str) else source.name


def _digest_of(source: places.Source) -> str:
    facts = []
    for root in (source.path, source.model):
        paths = [] if root is None else [root, *(sorted(root.rglob("*")) if root.is_dir() else ())]
        stats = [(str(path), path.stat()) for path in paths]
        facts.append([(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats])
    return plan.recipe_of([source.kind, facts])


def _base(folder: Folder, found: Sequence[tuple[places.Source | str, str]]) -> Manifest:
    """The manifest of the folder to add to."""
    content = folder.read(MANIFEST)
    if content is None:
        raise FileNotFoundError(f"{folder} holds no shards to add to: build it without --add first")
    base = Manifest.parse(content)
    if "sources" not in base.build:
        raise ValueError(f"{folder} was not written by `protomark build --ray`: build it anew")
    digests = {one["digest"] for one in base.build["sources"]}
    for source, digest in found:
        if digest in digests:
            raise ValueError(f"{_name(source)} is in {folder} already: leave it out")
    return base
