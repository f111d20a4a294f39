"""Runs `protomark evaluate-mapping`: the pipeline with several memories, and COLMAP."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import protomark as pm
from protomark.cli.terminal import comma_separated, note, progress_bar
from protomark.geometry.colmap import pycolmap
from protomark.geometry.pose import ground_plane
from protomark.mapping.memory import Memory
from protomark.mapping.options import MappingOptions
from protomark.threads import one_blas_thread
from protomark_bench import machine
from protomark_bench.cache import ResultCache, key_of
from protomark_bench.mapping import colmap, pipeline
from protomark_bench.mapping.memories import Descriptors, Medoids
from protomark_bench.mapping.results import (
    COLMAP,
    PROTOTYPES,
    TRADITIONAL,
    MappedSequence,
    MappingResults,
    MappingRun,
)
from protomark_bench.mapping.sequences import ImageSequence, error, open_sequences

# Constructors of memories by name, and numbers per prototype.
MEMORIES: dict[str, tuple[Callable[[MappingOptions], Memory], int]] = {
    TRADITIONAL: (Descriptors.of, 32),
    "medoid": (Medoids.of, 32),
    PROTOTYPES: (pipeline.RecordedPrototypes.of, 32),
    "prototypes-16": (pipeline.RecordedPrototypes.of, 16),
}


@dataclass(frozen=True)
class MappingRequest:
    """What to evaluate, and how.

    Attributes:
        sequences: folders with images/ and sparse/.
        output: folder of the cache.
        memories: names of `MEMORIES`.
        descriptor, encoder, max_keypoints: see `protomark map`.
        colmap: whether COLMAP runs, too.
        every: take every n-th image only.
        frames: take only so many of these images; 0: all.
        threads: threads of every run.
        command: the command line, for the report.
    """

    sequences: Sequence[Path]
    output: Path
    memories: Sequence[str]
    descriptor: str = "akaze"
    encoder: str = ""
    max_keypoints: int = 2000
    colmap: bool = True
    every: int = 1
    frames: int = 0
    threads: int = 1
    command: str = "protomark evaluate-mapping"

    def options(self, memory: str) -> MappingOptions:
        """Options of a map with this memory."""
        return MappingOptions(
            descriptor=self.descriptor,
            encoder=self.encoder,
            max_keypoints=self.max_keypoints,
            dim=MEMORIES[memory][1],
        )


def choose_memories(text: str) -> list[str]:
    """The memories of a list such as traditional,medoid; all of them if it is empty.

    Raises:
        ValueError: there is no memory of some name.
    """
    names = comma_separated(text)
    for name in names:
        if name not in MEMORIES:
            raise ValueError(f"there is no memory {name!r}: choose from {', '.join(MEMORIES)}")
    return [name for name in MEMORIES if not names or name in names]


def evaluate_mapping(request: MappingRequest) -> MappingResults:
    """Runs every memory on every sequence.

    Raises:
        FileNotFoundError, ValueError: a sequence is missing or broken.
    """
    sequences = open_sequences(request.sequences, request.every, request.frames)
    cache = ResultCache(request.output / "cache")
    cv2.setNumThreads(request.threads)
    order = [*request.memories, *([COLMAP] if request.colmap else [])]
    runs: dict[str, dict[str, MappingRun]] = {s.name: {} for s in sequences}
    interrupted = False
    with one_blas_thread():
        try:
            _make_runs(request, sequences, order, cache, runs)
        except KeyboardInterrupt:
            interrupted = True
    results = MappingResults(
        [_mapped(s, {m: runs[s.name][m] for m in order if m in runs[s.name]}) for s in sequences],
        [f"{s.name}, {m}" for s in sequences for m in order if m not in runs[s.name]],
        _conditions(request),
    )
    if interrupted:
        results.report().publish(request.output)
        raise KeyboardInterrupt
    return results


def _mapped(s: ImageSequence, runs: dict[str, MappingRun]) -> MappedSequence:
    """The runs on a sequence, with their errors."""
    true, other = s.centers, runs.get(TRADITIONAL)
    for memory, run in runs.items():
        errors = None
        if other is not None:
            ours, theirs = (
                error(run.centers, true, other.centers),
                error(other.centers, true, run.centers),
            )
            errors = None if ours is None or theirs is None else (ours, theirs)
        runs[memory] = replace(run, error=error(run.centers, true), common_errors=errors)
    plane = ground_plane(np.array(list(s.poses.values()))).tolist()
    return MappedSequence(s.name, len(s.source), s.available, s.truth, s.extent, runs, true, plane)


def _make_runs(
    request: MappingRequest,
    sequences: list[ImageSequence],
    order: Sequence[str],
    cache: ResultCache,
    runs: dict[str, dict[str, MappingRun]],
) -> None:
    """Add the runs of every memory by sequence, from the cache or new."""
    pairs = [(sequence, memory) for sequence in sequences for memory in order]
    with progress_bar() as progress:
        for sequence, memory in pairs:
            title, done = f"{sequence.name} by {memory}", 0

            def one_more(title: str = title, frames: int = len(sequence.source)) -> None:
                nonlocal done
                done += 1
                progress(title, done, frames)

            key = _key(request, sequence, memory)
            run = _cached(cache, key)
            if run is None:
                if memory == COLMAP:
                    run = colmap.run(sequence, request.threads, one_more)
                else:
                    options = request.options(memory)
                    run = pipeline.run(
                        sequence, memory, MEMORIES[memory][0], options, request.threads, one_more
                    )
                cache.save(key, asdict(run))
                note(
                    f"{title}: {run.registered} of {len(sequence.source)} frames, "
                    f"{run.wall_seconds:.0f} s"
                )
            runs[sequence.name][memory] = run


def _key(request: MappingRequest, sequence: ImageSequence, memory: str) -> str:
    """The key of a run in the cache, from everything that determines it."""
    files = [(n, (sequence.source.path / n).stat().st_size) for n in sequence.source.names()]
    made_of: dict[str, Any] = {"version": pycolmap.__version__, "exhaustive": colmap.EXHAUSTIVE}
    if memory != COLMAP:
        options = request.options(memory)
        encoder = pm.Encoder.load(options.encoder or options.descriptor)
        made_of = {"code": pipeline.code_digest(), "options": asdict(options)}
        made_of["encoder"] = encoder.identity
    return key_of(
        memory=memory,
        sequence=sequence.name,
        camera=sequence.camera.as_dict(),
        files=files,
        threads=request.threads,
        **made_of,
    )


def _cached(cache: ResultCache, key: str) -> MappingRun | None:
    found = cache.load(key)
    try:
        return None if found is None else MappingRun.from_dict(found)
    except (KeyError, TypeError):
        return None


def _conditions(request: MappingRequest) -> dict[str, str]:
    taken = f"every {request.every}th image" if request.every > 1 else "every image"
    limit = f"the first {request.frames} of them" if request.frames else "to the end"
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    return {
        "scale": f"{taken}, {limit}",
        "pipeline": f"{request.descriptor.upper()}, at most {request.max_keypoints} keypoints per "
        f"image, window of {MappingOptions().window} keyframes; poses unknown, camera known and "
        "fixed",
        "COLMAP": "SIFT on the CPU, its default options but with any distortion, camera known and "
        f"fixed; of more than {colmap.EXHAUSTIVE} images it matches pairs that are up to ten, or a "
        "power of two, apart"
        if request.colmap
        else "left out",
        "time": f"CPU seconds of the process, {request.threads} thread(s); load of the machine at "
        f"the end {load:.1f}",
        **machine.describe("opencv-contrib-python-headless", "pycolmap", "numpy"),
        "again": f"`{request.command}`",
    }
