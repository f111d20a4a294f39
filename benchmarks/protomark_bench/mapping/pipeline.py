"""Runs the pipeline on a sequence, and measures the drift of its prototypes."""

from __future__ import annotations

import hashlib
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark import mapping
from protomark.features.extractor import Extractor
from protomark.geometry.pose import camera_centers
from protomark.mapping.clock import Clock
from protomark.mapping.frame import InputImage
from protomark.mapping.mapper import Mapper
from protomark.mapping.memory import Memory, Prototypes, prototypes_for
from protomark.mapping.options import MappingOptions
from protomark.mapping.source import ImageFolder
from protomark.mapping.summary import summarise
from protomark_bench.mapping.results import Drift, MappingRun
from protomark_bench.mapping.sequences import ImageSequence

Ids = NDArray[np.int64]
# Number of frames whose search of the whole map is timed, and of repetitions; the fastest counts.
_TIMED_FRAMES, _TIMES = 9, 3
_COUNT_LIMIT = 255  # count at which a prototype's sums are halved


def code_digest() -> str:
    """A digest of the pipeline's code, so that cached runs of other code do not count."""
    digest = hashlib.sha256(pm.__version__.encode())
    for path in sorted(Path(mapping.__path__[0]).glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def run(
    sequence: ImageSequence,
    memory: str,
    new_memory: Callable[[MappingOptions], Memory],
    options: MappingOptions,
    threads: int,
    advance: Callable[[], None] = lambda: None,
) -> MappingRun:
    """Maps a sequence with unknown poses and a known camera.

    Args:
        sequence: the images.
        memory: name of the memory.
        new_memory: creates the memory.
        options: options of the map.
        threads: threads to search and adjust on.
        advance: called after each frame.
    """
    begin = time.perf_counter()
    mapper = Mapper(options, sequence.camera, threads, new_memory)
    # Processor time leaves out other programs on the machine.
    mapper.clock = Clock(time.process_time)
    for image in sequence.source.images():
        mapper.add(image)
        advance()

    def reread(names: set[str], backward: bool) -> Iterable[InputImage]:
        return sequence.source.images(only=names, backward=backward)

    mapper.finish(reread)
    wall = time.perf_counter() - begin
    facts = summarise(mapper)
    records = list(mapper.history.records.values())
    frames = mapper.structure.frames
    drift = None
    if isinstance(mapper.memory, RecordedPrototypes) and frames:
        drift = measure_drift(mapper, mapper.memory, sequence.source)
    return MappingRun(
        memory=memory,
        registered=len(frames),
        landmarks=facts["landmarks"],
        observations=facts["observations"],
        memory_bytes=facts["memory_bytes"],
        peak_bytes=max(r.memory_bytes for r in records),
        peak_window_bytes=max(r.memory_bytes + r.window_bytes for r in records),
        learning_bytes=facts["landmarks"] * (2 * options.dim + 1) if drift else None,
        seconds=facts["seconds"],
        wall_seconds=wall,
        search_ms=_search_ms(mapper, sequence) if facts["landmarks"] > 1 else None,
        error_pixels=facts["reprojection_error_mean"],
        not_registered={why: len(names) for why, names in facts["not_registered"].items()},
        events=facts["events"],
        drift=drift,
        centers={f.name: [float(f"{x:.6g}") for x in camera_centers(f.pose)] for f in frames},
        growth=[r.memory_bytes for r in records],
    )


def _search_ms(mapper: Mapper, sequence: ImageSequence) -> float:
    """Median milliseconds of a search, over frames that are spread over the sequence."""
    names = sequence.source.names()
    chosen = {names[i] for i in np.linspace(0, len(names) - 1, _TIMED_FRAMES).astype(int)}
    extractor = Extractor(mapper.options.descriptor, mapper.options.max_keypoints)
    found = []
    for image in sequence.source.images(only=chosen):
        if image.image is None:
            continue
        descriptors = extractor(image.image).descriptors
        times = []
        for _ in range(_TIMES):
            begin = time.process_time()
            mapper.memory.search(mapper.memory.encode(descriptors), mapper.threads)
            times.append(time.process_time() - begin)
        found.append(1e3 * min(times))
    return float(np.median(found)) if found else 0.0


class RecordedPrototypes(Prototypes):
    """A memory of prototypes that records all changes, so that the map can be rebuilt.

    Recording costs little while mapping; `observations` replays the record afterwards.
    """

    def __init__(self, encoder: pm.Encoder, dim: int) -> None:
        super().__init__(encoder, dim)
        self._record: list[tuple[str, Ids, NDArray[Any]]] = []

    @classmethod
    def of(cls, options: MappingOptions) -> RecordedPrototypes:
        """An empty memory for a map with these options."""
        prototypes = prototypes_for(options)
        return cls(prototypes.encoder, prototypes.dim)

    def add(self, ids: Ids, encoded: NDArray[Any]) -> None:
        """See `Memory.add`."""
        super().add(ids, encoded)
        self._record.append(("add", ids.copy(), encoded.copy()))

    def subtract(self, ids: Ids, encoded: NDArray[Any]) -> None:
        """See `Memory.subtract`."""
        super().subtract(ids, encoded)
        self._record.append(("subtract", ids.copy(), encoded.copy()))

    def merge_landmarks(self, into: Ids, source: Ids) -> None:
        """See `Memory.merge_landmarks`."""
        super().merge_landmarks(into, source)
        self._record.append(("merge", into.copy(), source.copy()))

    def remove(self, ids: Ids) -> None:
        """See `Memory.remove`."""
        super().remove(ids)
        self._record.append(("remove", ids.copy(), ids[:0]))

    def observations(self) -> tuple[Ids, NDArray[np.int8]]:
        """Landmarks (n,) and codes (n, dim) of all observations in the prototypes."""
        codes: dict[int, list[bytes]] = {}
        for change, ids, given in self._record:
            if change == "remove":
                for i in ids.tolist():
                    codes.pop(i, None)
            elif change == "merge":
                for into, source in zip(ids.tolist(), given.tolist(), strict=True):
                    codes.setdefault(into, []).extend(codes.pop(source, []))
            else:
                for i, code in zip(ids.tolist(), given, strict=True):
                    if change == "add":
                        codes.setdefault(i, []).append(code.tobytes())
                    else:
                        codes[i].remove(code.tobytes())
        ids = np.repeat(np.array(list(codes), np.int64), [len(c) for c in codes.values()])
        joined = b"".join(code for one in codes.values() for code in one)
        return ids, np.frombuffer(joined, np.int8).reshape(-1, self.dim)


def measure_drift(mapper: Mapper, memory: RecordedPrototypes, source: ImageFolder) -> Drift:
    """Compares the map of prototypes with maps that are built at once.

    The pipeline has added and subtracted observations frame by frame, and merged and removed
    landmarks. One map is built of the observations that were added and not subtracted, another one
    from the images, of the observations that the frames have at the end.
    """
    ids, codes = memory.observations()
    fresh = pm.PrototypeMap(memory.encoder, memory.dim)
    fresh.add_codes(ids, codes)
    seen, descriptors = _final_observations(mapper, source)
    of_frames = pm.PrototypeMap(memory.encoder, memory.dim)
    of_frames.add(seen, descriptors)
    return Drift(
        landmarks=len(memory.map),
        observations=len(ids),
        same_file=_saved(memory.map) == _saved(fresh),
        different=_different(memory.map, fresh),
        dropped=len(ids) - len(seen),
        different_from_frames=_different(memory.map, of_frames),
        halved=int((np.unique(ids, return_counts=True)[1] > _COUNT_LIMIT).sum()),
    )


def _different(one: pm.PrototypeMap, other: pm.PrototypeMap) -> int:
    """Number of landmarks that only one map has, or whose count or prototype differs."""
    both = np.intersect1d(one.ids, other.ids)
    different = one.counts(both) != other.counts(both)
    different |= (one.prototypes(both) != other.prototypes(both)).any(axis=1)
    return int(different.sum()) + len(one) + len(other) - 2 * len(both)


def _final_observations(mapper: Mapper, source: ImageFolder) -> tuple[Ids, NDArray[np.uint8]]:
    """Landmarks and descriptors of the observations that the frames have at the end."""
    extractor = Extractor(mapper.options.descriptor, mapper.options.max_keypoints)
    frames = {frame.name: frame for frame in mapper.structure.frames}
    ids, descriptors = [np.zeros(0, np.int64)], [np.zeros((0, mapper.descriptor_bytes), np.uint8)]
    for image in source.images(only=set(frames)):
        assert image.image is not None
        frame = frames[image.name]
        features = extractor(image.image)
        # No two keypoints of one image have the same coordinates (`extractor.MIN_DISTANCE`).
        at = {point.tobytes(): row for row, point in enumerate(features.keypoints)}
        rows = [at[point.tobytes()] for point in frame.keypoints[frame.observed]]
        ids.append(frame.seen)
        descriptors.append(features.descriptors[rows])
    return np.concatenate(ids), np.concatenate(descriptors)


def _saved(scene: pm.PrototypeMap) -> bytes:
    with tempfile.TemporaryDirectory(prefix="protomark-") as folder:
        path = Path(folder) / "scene.pmk"
        scene.save(path)
        return path.read_bytes()
