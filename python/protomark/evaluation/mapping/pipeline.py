"""One variant of the pipeline on one sequence."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import numpy as np

from protomark.evaluation.mapping.drift import drift
from protomark.evaluation.mapping.ledger import Ledger
from protomark.evaluation.mapping.results import Run
from protomark.localization.absolute_pose import centre
from protomark.mapping.clock import Clock
from protomark.mapping.mapper import Mapper, Picture
from protomark.mapping.memory import Prototypes
from protomark.mapping.summary import summarise
from protomark.tracks.features import Extractor

if TYPE_CHECKING:
    from protomark.evaluation.mapping.sequences import Sequence
    from protomark.mapping.settings import Settings

# Frames whose search of the whole map is timed, and how often each; the quickest counts.
_TIMED_FRAMES, _TIMES = 9, 3


def run(
    sequence: Sequence,
    variant: str,
    settings: Settings,
    threads: int,
    advance: Callable[[], None] = lambda: None,
) -> Run:
    """Map a sequence, its poses unknown and its camera known.

    Args:
        sequence: the images.
        variant: name of what the settings say.
        settings: of the map.
        threads: threads to search and adjust on.
        advance: called after each frame.
    """
    began = time.perf_counter()
    mapper = Mapper(settings, sequence.camera, threads)
    # Other programs on the machine shall not count.
    mapper.clock = Clock(time.process_time)
    for picture in sequence.source.pictures():
        _write_down(mapper)
        mapper.add(picture)
        advance()

    def again(names: set[str], backward: bool) -> Iterable[Picture]:
        return sequence.source.pictures(only=names, backward=backward)

    mapper.finish(again)
    wall = time.perf_counter() - began
    facts = summarise(mapper)
    entries = list(mapper.history.entries.values())
    frames = mapper.structure.frames
    return Run(
        variant=variant,
        centers={f.name: centre(f.pose).tolist() for f in frames},
        landmarks=facts["landmarks"],
        observations=facts["observations"],
        memory_bytes=facts["memory_bytes"],
        peak_bytes=max(e.memory_bytes for e in entries),
        peak_window_bytes=max(e.memory_bytes + e.window_bytes for e in entries),
        open_bytes=facts["open_map_bytes"],
        seconds=facts["seconds"],
        wall_seconds=wall,
        search_ms=_search_ms(mapper, sequence) if facts["landmarks"] > 1 else None,
        error_pixels=facts["reprojection_error_mean"],
        not_registered={why: len(names) for why, names in facts["not_registered"].items()},
        events=facts["events"],
        growth=[e.memory_bytes for e in entries],
        drift=drift(mapper, mapper.memory, sequence.source)
        if isinstance(mapper.memory, Ledger) and frames
        else None,
    )


def _write_down(mapper: Mapper) -> None:
    """A memory of prototypes that is empty yet becomes one that writes down what it is given."""
    memory = mapper.memory
    if isinstance(memory, Prototypes) and not isinstance(memory, Ledger) and not len(memory.map):
        mapper.memory = Ledger(memory.encoder, memory.dim)


def _search_ms(mapper: Mapper, sequence: Sequence) -> float:
    """Median over frames spread over the sequence."""
    names = sequence.source.names
    chosen = {names[i] for i in np.linspace(0, len(names) - 1, _TIMED_FRAMES).astype(int)}
    extractor = Extractor(mapper.settings.descriptor, mapper.settings.max_keypoints)
    found = []
    for picture in sequence.source.pictures(only=chosen):
        if picture.image is None:
            continue
        descriptors = extractor(picture.image).descriptors
        times = []
        for _ in range(_TIMES):
            began = time.process_time()
            mapper.memory.search(mapper.memory.encode(descriptors), mapper.threads)
            times.append(time.process_time() - began)
        found.append(1e3 * min(times))
    return float(np.median(found)) if found else 0.0
