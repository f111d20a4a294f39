"""One distributed build: its driver, which keeps facts on sources and shards, and no data."""

from __future__ import annotations

import json
import re
import tempfile
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.distributed import plan, tasks
from protomark.distributed.cluster import Tasks
from protomark.distributed.folder import Folder
from protomark.distributed.plan import Segment, ShardPlan, Source
from protomark.features.upright import SUFFIX
from protomark.files import MANIFEST, natural_key
from protomark.geometry.camera import Camera
from protomark.maps import sources as places
from protomark.maps.build import check_encoder, chosen_appearance_bits, chosen_dim
from protomark.maps.info import describe_shards
from protomark.maps.origin import OF_SOURCES, sources_metadata
from protomark.maps.places import KEY as PLACES
from protomark.maps.shards import Manifest, Shard, encoder_facts, shard_from
from protomark.progress import Progress
from protomark.tracks.file import shipped_encoder
from protomark.tracks.joining import MAX_ID, shifted_ids


@dataclass(frozen=True)
class Request:
    """How to build: see `protomark.distributed.build`; `memory` is in bytes."""

    output: Folder
    dim: int | None = None
    min_observations: int | None = None
    metadata: Mapping[str, str] = field(default_factory=dict)
    seal: bool = True
    cell_size: float | None = None
    memory: int = plan.MIN_MEMORY
    resume: bool = False
    add: bool = False
    piece: int | None = None


class Parts:
    """What the pieces of a source hand over to shards."""

    def __init__(
        self,
        source: Source,
        number: int,
        plans: Sequence[ShardPlan],
        left: Sequence[ShardPlan],
        memory: int,
        dim: int,
        piece: int | None,
    ) -> None:
        self.source = source
        self.segments = [s for one in plans for s in one.segments if s.source == number]
        # The shards that wait for it.
        self.shards = [one for one in left if any(s.source == number for s in one.segments)]
        self.step = piece or plan.piece_rows(memory, source.descriptor_bytes, dim)
        self.starts = range(0, source.keypoints, self.step) if self.shards else range(0)
        self.left, self._waiting = len(self.starts), len(self.shards)
        self.groups = plan.group_count(len(self.segments), self.step, dim)
        self.boundaries = [int(source.firsts[s.start // plan.BUCKET]) for s in self.segments[1:]]
        self.parts: dict[int, list[Any]] = {}  # references, by the first row of the piece

    def input(self, segment: Segment) -> tasks.Input:
        """What a shard takes."""
        number, total = self.segments.index(segment), len(self.segments)
        ends = [plan.segments_of(group, self.groups, total) for group in range(self.groups)]
        group = next(i for i, (first, last) in enumerate(ends) if first <= number < last)
        refs = [self.parts[start][group] for start in self.starts]
        inside = number - ends[group][0]
        return tasks.Input(self.source, segment.start, segment.stop, inside, refs)

    def hand_over(self) -> None:
        """Note that the task of a shard has the references that it needs."""
        self._waiting -= 1
        if not self._waiting:
            self.parts.clear()


class Job:
    """One build, of which the driver keeps facts only."""

    def __init__(
        self,
        ray: Any,
        running: Tasks,
        request: Request,
        encoder: pm.Encoder | None,
        base: Manifest | None,
        progress: Progress,
    ) -> None:
        self.ray, self.running, self.request = ray, running, request
        self.base, self.progress = base, progress
        self.given = encoder
        self.work: dict[str, float] = defaultdict(float)

    def run(self, found: Sequence[tuple[places.Source | str, str]]) -> dict[str, Any]:
        """Build a map of sources, each with its digest; returns facts."""
        began = time.perf_counter()
        request, output = self.request, self.request.output
        texts = self._texts()
        self._check_versions()
        sources = self._open_sources(found)
        encoder = self.encoder = self.given or self._shipped(sources)
        self._check_descriptors(sources)
        self.dim = chosen_dim(encoder, request.dim)
        self.bits = chosen_appearance_bits(self.dim)
        if self.base and (encoder_facts(encoder), self.dim) != (self.base.encoder, self.base.dim):
            raise ValueError(
                f"{output} is of encoder '{self.base.encoder['name']}' with {self.base.dim} "
                f"numbers, not of '{encoder.name}' with {self.dim}: give the same"
            )
        self._number(sources)
        costs = self._count(sources)
        if request.cell_size is not None and (self.base or PLACES in _metadata(sources)):
            raise ValueError(
                "--cell-size cuts one world, but these are several places with coordinates of "
                "their own: leave it out, or `protomark merge` the maps of the places first"
            )
        plans = self._plan(sources, plan.cut_segments(costs, request.memory), texts)
        shards, reused = self._write(sources, plans)
        if not shards:
            raise ValueError("no landmark is left")
        manifest = self._manifest(sources, shards, texts)
        self._publish(manifest)
        busy = self.work["seconds"]
        return describe_shards(str(output), manifest) | {
            "sources": [source.facts for source in sources],
            "run": {
                "seconds": time.perf_counter() - began,
                "observations": int(self.work["observations"]),
                "observations_per_worker_second": self.work["observations"] / max(busy, 1e-9),
                "bytes_moved": int(self.work["bytes_moved"]),
                "retries": int(self.work["retries"]),
                "shards_written": len(shards) - reused,
                "shards_taken_over": len(manifest.shards) - len(shards) + reused,
            },
        }

    def _texts(self) -> dict[str, str]:
        """The user's metadata; those of the build that is resumed, if that began otherwise."""
        name, output = f"{tasks.WORK}/plan.json", self.request.output
        texts = dict(self.request.metadata)
        if self.request.resume and (content := output.read(name)) is not None:
            texts |= {k: v for k, v in json.loads(content).items() if k == "created"}
        elif not self.request.resume:
            output.remove(tasks.WORK)
        output.write(name, json.dumps(texts).encode())
        return texts

    def _check_versions(self) -> None:
        found: list[str] = []
        self.running.start(found.append, tasks.worker_version)
        self.running.wait()
        if found[0] != pm.__version__:
            raise ValueError(
                f"workers have Protomark {found[0]}, this machine {pm.__version__}: install the "
                "same on all"
            )

    def _open_sources(self, found: Sequence[tuple[places.Source | str, str]]) -> list[Source]:
        opened: dict[int, Source] = {}
        descriptor = self.given.descriptor if self.given else None
        # Images and databases may be of any descriptor: they come last.
        last = [
            i
            for i, (one, _) in enumerate(found)
            if not isinstance(one, str) and one.kind not in ("map", "tracks")
        ]
        for numbers in ([i for i in range(len(found)) if i not in last], last):
            for i in numbers:
                one, digest = found[i]
                self.running.start(
                    partial(opened.__setitem__, i),
                    tasks.open_source,
                    *(one, digest, self.request.output, descriptor),
                )
            self._drain("read sources", len(found))
            if opened and descriptor is None:
                descriptor = opened[min(opened)].descriptor
        return [opened[i] for i in range(len(found))]

    def _drain(self, stage: str, total: int) -> None:
        while len(self.running):
            self.progress(stage, total - len(self.running), total)
            self.running.wait()

    def _shipped(self, sources: Sequence[Source]) -> pm.Encoder:
        detectors = [source.info.get("detector", {}) for source in sources]
        return pm.Encoder.load(shipped_encoder(sources[0].descriptor, detectors))

    def _check_descriptors(self, sources: Sequence[Source]) -> None:
        encoder = self.encoder
        for source in sources:
            upright = encoder.descriptor == source.descriptor + SUFFIX
            bits = 8 * source.descriptor_bytes + (64 if upright else 0)
            name = encoder.descriptor if upright else source.descriptor
            try:
                check_encoder(encoder, name, source.input, bits)
            except ValueError as error:
                raise ValueError(f"{source.shown}: {error}") from None

    def _number(self, sources: Sequence[Source]) -> None:
        """Give each source ids above those of the sources before it."""
        last = -1 if self.base is None else max(shard.ids[1] for shard in self.base.shards)
        if self.base is not None:
            last = max(last, *(one["facts"]["ids"][1] for one in self.base.build["sources"]))
        for source in sources:
            first, end = source.ids
            source.shift = max(0, last + 1 - first) if source.landmarks else 0
            if end > MAX_ID - source.shift:
                raise ValueError(
                    f"{source.shown}: ids up to {end} do not fit above {last}: use smaller ids"
                )
            last = max(last, end + source.shift)

    def _count(self, sources: Sequence[Source]) -> list[NDArray[np.int64]]:
        """Count observations: facts on each source, and what its landmarks cost."""
        request = self.request
        step = plan.data_bytes(request.memory) // 48 // plan.BUCKET * plan.BUCKET
        counted: dict[tuple[int, int], tasks.Counted] = {}
        limit = 2 if request.min_observations is None else request.min_observations
        for i, source in enumerate(sources):
            for start in range(0, source.landmarks, step):
                self.running.start(
                    partial(counted.__setitem__, (i, start)),
                    tasks.count,
                    *(source.url, start, min(start + step, source.landmarks), limit),
                    2**self.bits,
                )
        self._drain("count observations", len(self.running))
        costs = []
        for i, source in enumerate(sources):
            own = [counted[key] for key in sorted(counted) if key[0] == i]
            highest = max((one.highest for one in own), default=0)
            try:
                source.limit = places.fewest_observations(highest, request.min_observations)
            except ValueError as error:
                raise ValueError(f"{source.shown}: {error}") from None
            short = sum(one.short for one in own) if source.limit == limit else 0
            told = places.with_dropped(source.info["source"], source.limit, short)
            shifted = shifted_ids(told, source.shift) if source.shift else told
            source.facts = places.source_facts(
                source.name,
                {**source.info, "source": shifted},
                {
                    "keyframes": source.keyframes,
                    "landmarks": source.landmarks,
                    "observations": sum(one.observations for one in own),
                },
                source.descriptor,
                source.cameras,
                [number + source.shift for number in source.ids],
            )
            source.firsts = np.concatenate([one.firsts for one in own])
            costs.append(np.concatenate([one.costs for one in own]))
        return costs

    def _plan(
        self,
        sources: Sequence[Source],
        cut: Sequence[Sequence[Segment]],
        texts: dict[str, str],
    ) -> list[ShardPlan]:
        plans = []
        common = (pm.__version__, encoder_facts(self.encoder), self.dim, self.bits)
        for segments in cut:
            own = [sources[segment.source] for segment in segments]
            metadata = _metadata(own) | texts
            recipe = plan.recipe_of(
                [
                    common,
                    self.request.seal,
                    self.request.cell_size,
                    metadata,
                    [
                        (one.digest, segment.start, segment.stop, one.shift, one.limit)
                        for one, segment in zip(own, segments, strict=True)
                    ],
                ]
            )
            plans.append(ShardPlan(tuple(segments), metadata, recipe))
        return plans

    def _finished(self, plans: Sequence[ShardPlan]) -> dict[str, list[Shard]]:
        """The shards that an earlier build wrote, by their recipes."""
        found: dict[str, list[Shard]] = {}
        output = self.request.output
        for one in plans if self.request.resume else ():
            content = output.read(f"{tasks.WORK}/{one.recipe}.json")
            if content is None:
                continue
            shards = [shard_from(facts) for facts in json.loads(content)]
            files = [file for shard in shards for file in shard.files]
            if all(output.size(file.name) == file.bytes for file in files):
                found[one.recipe] = shards
        return found

    def _write(
        self, sources: Sequence[Source], plans: Sequence[ShardPlan]
    ) -> tuple[list[Shard], int]:
        """Encode piece by piece and write shard by shard what is not finished."""
        written = self._finished(plans)
        reused = len(written)
        request, encoder = self.request, self.ray.put(_content(self.encoder))
        common = (encoder, self.dim)
        left = [one for one in plans if one.recipe not in written]
        parts = {
            i: Parts(source, i, plans, left, request.memory, self.dim, request.piece)
            for i, source in enumerate(sources)
        }
        pieces = ((one, start) for one in parts.values() for start in one.starts)
        total, done = sum(len(one.starts) for one in parts.values()) + len(left), 0

        def encoded(one: Parts, work: tasks.Work) -> None:
            self.work["observations"] += work.observations
            self._note(work)
            one.left -= 1
            for shard in one.shards if not one.left else ():
                inputs = [(parts[s.source], s) for s in shard.segments]
                if any(other.left for other, _ in inputs):
                    continue
                self.running.start(
                    partial(finished, shard.recipe),
                    tasks.write_shard,
                    *(shard.recipe, [other.input(s) for other, s in inputs]),
                    *(shard.metadata, *common, self.bits),
                    *(request.seal, request.cell_size, request.output),
                )
                for other, _ in inputs:
                    other.hand_over()

        def finished(recipe: str, result: tuple[list[Shard], tasks.Work]) -> None:
            written[recipe] = result[0]
            self._note(result[1])

        # So many tasks keep all workers busy, and shards are written before all is encoded.
        window = 4 * max(2, int(self.ray.cluster_resources().get("CPU", 2)))
        while True:
            while len(self.running) < window and (piece := next(pieces, None)) is not None:
                one, start = piece
                one.parts[start] = self.running.start(
                    partial(encoded, one),
                    tasks.encode_piece,
                    *(one.source, start, start + one.step, one.boundaries, one.groups, *common),
                    results=1 + one.groups,
                )
            if not len(self.running):
                break
            self.progress("build", done, total)
            self.running.wait()
            done += 1
        shards = [shard for one in plans for shard in written[one.recipe]]
        if request.cell_size is not None:
            shards = self._join_cells(shards, plans[0].metadata)
        return shards, reused

    def _join_cells(self, parts: Sequence[Shard], metadata: dict[str, str]) -> list[Shard]:
        """Write a shard for each cube of space, of the parts that lie in it."""
        cells: dict[str, list[Shard]] = {}
        for part in parts:
            cells.setdefault(part.name, []).append(part)
        request, joined = self.request, dict[str, Shard]()

        def finished(cell: str, result: tuple[Shard, tasks.Work]) -> None:
            joined[cell] = result[0]
            self._note(result[1])

        room = plan.data_bytes(request.memory) // plan.PROTOTYPE_BYTES
        for cell, own in cells.items():
            if (count := sum(part.prototypes for part in own)) > room:
                raise ValueError(
                    f"cube {cell} has {count:,} prototypes, more than the {room:,} that --memory "
                    f"{request.memory / 1e6:g} holds: give a smaller --cell-size or more memory"
                )
            names = [file.name for part in own for file in part.files]
            self.running.start(
                partial(finished, cell),
                tasks.join_cell,
                *(cell, names, metadata, request.seal, request.output),
            )
        self._drain("join cubes", len(cells))
        return [joined[cell] for cell in sorted(joined, key=natural_key)]

    def _note(self, work: tasks.Work) -> None:
        self.work["seconds"] += work.seconds
        self.work["bytes_moved"] += work.bytes_moved
        self.work["retries"] += work.retries

    def _manifest(
        self, sources: Sequence[Source], shards: list[Shard], texts: dict[str, str]
    ) -> Manifest:
        rows = [
            {
                "digest": one.digest,
                "facts": one.facts,
                "detector": one.info.get("detector", {}),
                "cameras": [str(camera) for camera in one.cameras],
            }
            for one in sources
        ]
        before: list[dict[str, Any]] = []
        if self.base is not None:
            before = self.base.build["sources"]
            users = {k: v for k, v in self.base.metadata.items() if k not in OF_SOURCES}
            texts = users | {k: v for k, v in texts.items() if k not in users or k != "created"}
            shards = [*self.base.shards, *shards]
        rows = [*before, *rows]
        metadata = sources_metadata(
            [one["facts"] for one in rows],
            [one["detector"] for one in rows],
            [Camera.parse(text) for one in rows for text in one["cameras"]],
        )
        request = self.request
        return Manifest(
            encoder_facts(self.encoder),
            self.dim,
            self.bits,
            metadata | texts,
            shards,
            {
                "protomark": pm.__version__,
                "memory": request.memory,
                "min_observations": request.min_observations,
                "sources": rows,
            },
        )

    def _publish(self, manifest: Manifest) -> None:
        """Make the new shards the content of the folder, and remove what it no longer needs."""
        output = self.request.output
        output.write(MANIFEST, manifest.text().encode())
        kept = {file.name for shard in manifest.shards for file in shard.files}
        for name in output.names():
            if re.fullmatch(r"shard-[\w-]+-[0-9a-f]{8}(\.sealed)?\.pmk", name) and name not in kept:
                output.remove(name)
        output.remove(tasks.WORK)


def _metadata(sources: Sequence[Source]) -> dict[str, str]:
    """What the maps of sources say of themselves."""
    return sources_metadata(
        [one.facts for one in sources],
        [one.info.get("detector", {}) for one in sources],
        [camera for one in sources for camera in one.cameras],
    )


def _content(encoder: pm.Encoder) -> bytes:
    """The content of an encoder's file."""
    with tempfile.TemporaryDirectory(prefix="protomark-") as folder:
        path = Path(folder) / "encoder.pme"
        encoder.save(path)
        return path.read_bytes()
