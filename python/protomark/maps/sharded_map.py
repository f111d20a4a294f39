"""A map whose landmarks are in several files, its shards."""

from __future__ import annotations

import copy
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

import protomark as pm
from protomark.files import SCENE_MAP, SEALED_MAP
from protomark.maps.neighbours import Found, accepted, merged
from protomark.maps.open import map_path, open_map
from protomark.maps.shards import (
    Manifest,
    Shard,
    ShardFile,
    describe_file,
    describe_shard,
    disjoint,
    encoder_facts,
    file_identity,
    is_sharded,
)

Ids = NDArray[np.int64]
T = TypeVar("T")


class ShardedMap:
    """A map in a folder of shards, or in one file, that only answers.

        city = pm.ShardedMap("city")
        ids, distances = city.search(descriptors, k=2)

    Answers are those of one map of all landmarks, bit for bit. A shard is opened when a call first
    touches it; a sealed one is mapped from disk. Threads may share the map, and change its shards
    while others search: a search sees the shards that were there when it began.

    Args:
        path: a folder with a manifest, which `protomark build --ray` and `protomark split` write; a
            map file; or the folder of `protomark map`.

    Raises:
        FileNotFoundError: there is no manifest or map.
        FileError, ValueError: the manifest or the first shard is broken, or they disagree.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._lock = threading.Lock()
        self._manifest: Manifest | None = None
        self._view = _View([])
        if self.path.is_dir() and not any(
            (self.path / name).is_file() for name in (SCENE_MAP, SEALED_MAP)
        ):
            self.refresh()
        else:
            self._view = _View([_Part(map_path(self.path))])
        first = self._view.parts[0].map
        self.encoder: pm.Encoder = first.encoder
        self.dim: int = first.dim
        # Whether prototypes were tuned, and bits per coordinate, as of the first shard.
        self.tuned: bool = isinstance(first, pm.SealedMap) and first.tuned

    def refresh(self) -> None:
        """Read the manifest again: shards come and go as it says; those that stay, stay open.

        Raises:
            FileNotFoundError, ValueError: it is not there, broken, or of another encoder than
                before; the map stays as it was.
        """
        manifest = Manifest.load(self.path)
        with self._lock:
            before = self._manifest
            if before and (manifest.encoder, manifest.dim) != (before.encoder, before.dim):
                raise ValueError(
                    f"{self.path} is now of encoder {manifest.encoder.get('name')!r} with "
                    f"{manifest.dim} numbers, other than before: open it anew"
                )
            same = {part.shard: part for part in self._view.parts}
            self._view = _View(
                [
                    same.get(shard) or _Part(self.path / shard.answering.name, manifest, shard)
                    for shard in manifest.shards
                ]
            )
            self._manifest = manifest

    def add_shard(self, path: str | os.PathLike[str]) -> str:
        """Add a map file as a further shard of this object, not of the folder; returns its name.

        Raises:
            FileNotFoundError, FileError: there is no such map, or it is broken.
            ValueError: it is of another encoder or dim, there is a shard of its name, or it has an
                id that is in the map.
        """
        part = _Part(map_path(path))
        _check_alike(part.path, part.map, encoder_facts(self.encoder), self.dim)
        ids = part.map.ids
        with self._lock:
            if any(part.shard.name == other.shard.name for other in self._view.parts):
                raise ValueError(f"there is a shard {part.shard.name} already: remove it first")
            for other in self._view.parts:
                low, high = other.shard.ids
                if (ids[(ids >= low) & (ids <= high)]).size and np.isin(ids, other.ids).any():
                    raise ValueError(f"{part.path} has ids that are in shard {other.shard.name}")
            self._view = _View([*self._view.parts, part])
        return part.shard.name

    def remove_shard(self, name: str) -> None:
        """Remove a shard from this object, not from the folder.

        Raises:
            KeyError: there is no such shard.
        """
        with self._lock:
            rest = tuple(part for part in self._view.parts if part.shard.name != name)
            if len(rest) == len(self._view.parts):
                raise KeyError(f"there is no shard {name}")
            self._view = _View(rest)

    def snapshot(self) -> ShardedMap:
        """This map with the shards that it has now, whatever comes and goes meanwhile."""
        return copy.copy(self)

    @property
    def shards(self) -> tuple[Shard, ...]:
        """The shards."""
        return tuple(part.shard for part in self._view.parts)

    def __len__(self) -> int:
        return sum(shard.landmarks for shard in self.shards)

    def __repr__(self) -> str:
        return f"<ShardedMap of {len(self)} landmarks in {len(self.shards)} shards: {self.path}>"

    @property
    def metadata(self) -> MappingProxyType[str, str]:
        """What the map says of itself: texts by name."""
        if self._manifest is not None:
            return MappingProxyType(dict(self._manifest.metadata))
        return self._view.parts[0].map.metadata

    @property
    def prototype_count(self) -> int:
        """Number of prototypes."""
        return sum(shard.prototypes for shard in self.shards)

    @property
    def nlist(self) -> int:
        """Number of inverted lists in all shards; 0: no shard has an index."""
        return sum(part.nlist for part in self._view.parts)

    @property
    def ids(self) -> Ids:
        """The ids of all landmarks in ascending order, (n,) int64; opens all shards."""
        return np.sort(np.concatenate([part.ids for part in self._view.parts]))

    def every(self, step: int) -> Ids:
        """Every so many-th id of each shard; opens all, and holds all ids of one at a time."""
        return self._ask(lambda view: np.concatenate([part.map.ids[::step] for part in view.parts]))

    def summary(self) -> dict[str, Any]:
        """The map at a glance, as `PrototypeMap.summary` has it, from the manifest."""
        shards = self.shards
        boxes = np.array([shard.box for shard in shards if shard.box is not None])
        extent = np.array([boxes[:, 0].min(0), boxes[:, 1].max(0)]) if len(boxes) else None
        placed = sum(shard.placed for shard in shards)
        return {"landmarks_with_position": placed, "extent": extent}

    def positions(self, landmark_ids: ArrayLike) -> NDArray[np.float64]:
        """World coordinates, (n, 3) float64, NaN where a landmark has none.

        Raises:
            KeyError: an id is not in the map.
        """
        ids = np.asarray(landmark_ids, np.int64)

        def look_up(view: _View) -> NDArray[np.float64]:
            found = np.full((len(ids), 3), np.nan)
            for part, rows in view.locate(ids):
                found[rows] = part.map.positions(ids[rows])
            return found

        return self._ask(look_up)

    def prototypes(self, landmark_ids: ArrayLike) -> NDArray[np.float32]:
        """Mean codes, (n, dim) float32, as `SealedMap.prototypes` has them.

        Raises:
            KeyError: an id is not in the map.
        """
        ids = np.asarray(landmark_ids, np.int64)

        def look_up(view: _View) -> NDArray[np.float32]:
            found = np.zeros((len(ids), self.dim), np.float32)
            for part, rows in view.locate(ids):
                found[rows] = part.map.prototypes(ids[rows])
            return found

        return self._ask(look_up)

    def visible(self, test: Callable[[NDArray[np.float64], float], NDArray[np.bool_]]) -> Ids:
        """The ids of landmarks that a test of positions finds visible; opens few shards.

        Args:
            test: takes positions (n, 3) and how far off they may be, and says (n,) whether each may
                be visible. It is asked for the middle of a shard's box before its landmarks.
        """

        def look(view: _View) -> Ids:
            found = []
            for part in view.parts:
                if part.shard.box is None:
                    continue
                low, high = np.array(part.shard.box)
                if test((low + high)[None] / 2, float(np.linalg.norm(high - low)) / 2)[0]:
                    found.append(part.ids[test(part.positions, 0.0)])
            return np.concatenate([*found, np.zeros(0, np.int64)])

        return self._ask(look)

    def nprobe(self, recall: float) -> int:
        """Number of inverted lists that a search with this recall visits in all shards.

        Raises:
            ValueError: recall is not in (0, 1], or no shard has an index.
        """
        with_index = [part for part in self._view.parts if part.nlist]
        if not with_index:
            raise ValueError("no shard has an index, so search without recall")
        return sum(part.map.nprobe(recall) for part in with_index)

    def search(
        self,
        descriptors: NDArray[np.uint8],
        k: int = 2,
        max_distance: int | None = None,
        ratio: float | None = None,
        threads: int = 1,
        recall: float | None = None,
        among: ArrayLike | None = None,
    ) -> Found:
        """Find the k nearest landmarks of each descriptor, as `SealedMap.search` does.

        With `recall`, shards without an index are searched exactly.
        """
        codes = self.encoder.encode(descriptors, self.dim, threads)
        return self.search_codes(codes, k, max_distance, ratio, threads, recall, among)

    def search_codes(
        self,
        codes: NDArray[np.int8],
        k: int = 2,
        max_distance: int | None = None,
        ratio: float | None = None,
        threads: int = 1,
        recall: float | None = None,
        among: ArrayLike | None = None,
    ) -> Found:
        """Like search, for descriptors that are encoded already: (q, dim) int8."""
        if recall is not None and not self.nlist:
            raise ValueError("no shard has an index, so search without recall")
        width = k if ratio is None else max(k, 2)  # the ratio test needs the second nearest
        limit = max_distance if ratio is None else None

        def look(view: _View) -> Found:
            answers = self._searches(view.chosen(among), codes, width, limit, threads, recall)
            # Among no landmarks: what any map says to that.
            return merged(
                answers or [view.parts[0].map.search_codes(codes, width, limit, among=[])],
                width,
                view.ascending,
            )

        return accepted(*self._ask(look), k, max_distance, ratio)

    def search_shards(
        self,
        chosen: Sequence[tuple[str, Ids | None]],
        codes: NDArray[np.int8],
        k: int,
        max_distance: int | None = None,
        recall: float | None = None,
    ) -> Found:
        """Search some shards: the identities of their files, and ids to search there or None.

        Raises:
            FileNotFoundError: the folder holds another version of a shard.
        """

        def look(view: _View) -> Found:
            parts = {part.shard.answering.identity: part for part in view.parts}
            if gone := [identity for identity, _ in chosen if identity not in parts]:
                raise FileNotFoundError(f"{self.path} holds no shard {gone[0]}: open it anew")
            named = [(parts[identity], some) for identity, some in chosen]
            return merged(self._searches(named, codes, k, max_distance, 1, recall), k)

        return self._ask(look)

    def _searches(
        self,
        chosen: Iterable[tuple[_Part, Ids | None]],
        codes: NDArray[np.int8],
        k: int,
        max_distance: int | None,
        threads: int,
        recall: float | None,
    ) -> list[Found]:
        """What each of these shards finds, see `_View.chosen`; a subclass may ask elsewhere."""
        return [
            part.map.search_codes(
                codes,
                k,
                max_distance,
                threads=threads,
                recall=recall if part.nlist else None,
                among=some,
            )
            for part, some in chosen
        ]

    def _ask(self, question: Callable[[_View], T]) -> T:
        try:
            return question(self._view)
        except FileNotFoundError:
            if self._manifest is None:
                raise
            self.refresh()  # another version may have replaced the shards that were not open
            return question(self._view)

    def verify(self) -> None:
        """Read all files of all shards, and check them against their checksums.

        Raises:
            FileNotFoundError, FileError, ValueError: a file is missing or broken, or is not what
                the manifest says.
        """
        for part in self._view.parts:
            for file in part.shard.files:
                path = part.path.with_name(file.name)
                _check_file(path, file)
                pm.verify_file(path)
        view = self._view
        if not view.ascending and len(np.unique(self.ids)) < len(self):
            raise ValueError(f"{self.path}: shards have landmarks in common")


class _Part:
    """A shard and, once something touched it, its map."""

    def __init__(self, path: Path, manifest: Manifest | None = None, shard: Shard | None = None):
        self.path = path
        self._manifest, self._shard = manifest, shard

    # Two threads may both open it; the last one stays.
    @cached_property
    def map(self) -> pm.PrototypeMap | pm.SealedMap:
        shard, manifest = self._shard, self._manifest
        if shard is None or manifest is None:
            return open_map(self.path)
        _check_file(self.path, shard.answering)
        scene = pm.open(self.path)
        _check_alike(self.path, scene, manifest.encoder, manifest.dim)
        if len(scene) != shard.landmarks:
            raise pm.FileError(
                f"{self.path} has {len(scene)} landmarks, its manifest says {shard.landmarks}"
            )
        return scene

    @cached_property
    def shard(self) -> Shard:
        """What the manifest says, or, without one, the map itself, which is read for that."""
        if self._shard is not None:
            return self._shard
        kind = "sealed" if isinstance(self.map, pm.SealedMap) else "learning"
        name = self.path.name.removesuffix(".pmk")
        return describe_shard(name, self.map, **{kind: describe_file(self.path)})

    @property
    def nlist(self) -> int:
        return self.map.nlist if self._shard is None else self._shard.answering.nlist

    @cached_property
    def ids(self) -> Ids:
        return self.map.ids

    @cached_property
    def positions(self) -> NDArray[np.float64]:
        return self.map.positions(self.ids)


class _View:
    """Shards that do not change, by their smallest ids."""

    def __init__(self, parts: Sequence[_Part]) -> None:
        alone = len(parts) < 2  # a map file that nobody described stays unread
        self.parts = tuple(parts if alone else sorted(parts, key=lambda part: part.shard.ids))
        # Whether all ids of a shard are above those of the shards before it.
        self.ascending = alone or disjoint([part.shard for part in self.parts])

    @cached_property
    def all_ids(self) -> Ids:
        return np.sort(np.concatenate([part.ids for part in self.parts]))

    def locate(self, ids: Ids) -> Iterator[tuple[_Part, NDArray[np.int64]]]:
        """Shards, each with the rows of those ids that it holds.

        Raises:
            KeyError: no shard holds an id.
        """
        left = np.arange(len(ids))
        if len(self.parts) == 1:
            yield self.parts[0], left
            return
        for part in self.parts:
            low, high = part.shard.ids
            near = (ids[left] >= low) & (ids[left] <= high)
            if near.any() and not self.ascending:
                near[near] = np.isin(ids[left[near]], part.ids)
            if near.any():
                yield part, left[near]  # where ranges are disjoint, its map finds unknown ids
                left = left[~near]
        if len(left):
            raise KeyError(f"landmark {ids[left[0]]} is not in the map")

    def chosen(self, among: ArrayLike | None) -> Iterator[tuple[_Part, Ids | None]]:
        """Shards to search, each with the landmarks to search there; None: all."""
        if among is None:
            yield from ((part, None) for part in self.parts)
            return
        ids = np.asarray(among)
        if ids.dtype == bool:
            if len(ids) != len(self.all_ids):
                raise ValueError(
                    f"a mask of {len(ids)} landmarks, but the map has {len(self.all_ids)}"
                )
            ids = self.all_ids[ids]
        ids = ids.astype(np.int64)
        yield from ((part, ids[rows]) for part, rows in self.locate(ids))


def open_scene(path: str | os.PathLike[str]) -> pm.PrototypeMap | pm.SealedMap | ShardedMap:
    """Open a map: one file, the folder of `protomark map`, or a folder of shards."""
    return ShardedMap(path) if is_sharded(path) else open_map(path)


def _check_file(path: Path, file: ShardFile) -> None:
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} is missing, which its manifest names: copy it there, or build anew"
        )
    found = path.stat().st_size
    if found != file.bytes:
        raise pm.FileError(
            f"{path} has {found:,} bytes, but its manifest says {file.bytes:,}: copy it again"
        )
    if file_identity(path) != file.identity:
        raise pm.FileError(f"{path} is another file than its manifest says: copy it again")


def _check_alike(
    path: Path, scene: pm.PrototypeMap | pm.SealedMap, encoder: Mapping[str, str], dim: int
) -> None:
    if (scene.encoder.identity, scene.dim) != (encoder["identity"], dim):
        raise pm.FileError(
            f"{path} is of encoder '{scene.encoder.name}' with {scene.dim} numbers, the other "
            f"shards of '{encoder['name']}' with {dim}: build all with the same"
        )
