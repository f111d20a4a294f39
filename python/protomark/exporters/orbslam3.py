"""Writes an atlas of ORB-SLAM3 (`.osa`) anew, smaller and with one descriptor per landmark.

Each observation of a landmark gets the majority vote of all its descriptors, and keypoints without
a landmark are left out. All else is copied, byte by byte.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.baselines.binary import majority
from protomark.baselines.support import Support
from protomark.files import replacing
from protomark.tracks.importers import orbslam3
from protomark.tracks.importers.orbslam3_atlas import NAMED, AtlasReader, Keyframe, Map, Point


def write_orbslam3(source: Path, output: Path) -> dict[str, Any]:
    """Write the atlas in `source` anew; returns what it holds.

    Raises:
        FileNotFoundError, ValueError: see `orbslam3.read`.
    """
    tracks = orbslam3.read(source)
    data = source.read_bytes()
    plans = [_plan(one) for one in AtlasReader(data, source).atlas().maps]
    writer = _AtlasWriter(data, source, plans)
    with replacing(output) as file:
        file.writelines(writer.written())
    return {
        "keyframes": len(tracks.keyframe_names),
        "landmarks": len(tracks.landmark_ids),
        "observations": len(tracks.observations),
        "dropped_keypoints": sum(p.dropped for plan in plans for p in plan.keyframes),
        "bytes_before": len(data),
        "bytes": output.stat().st_size,
    }


@dataclass
class _Kept:
    """What becomes of a keyframe's keypoints."""

    rows: NDArray[np.int64]  # (k,) of those that remain
    descriptors: NDArray[np.uint8]  # (k, 32), theirs
    new_row: dict[int, int]  # by the row that a keypoint had
    dropped: int

    def renumbered(self, rows: list[int]) -> list[int]:
        """The new rows of those that remain."""
        return [self.new_row[row] for row in rows if row in self.new_row]


@dataclass
class _Plan:
    """What becomes of a map."""

    keyframes: list[_Kept]
    new_rows: dict[int, dict[int, int]]  # by keyframe id
    voted: list[bytes | None]  # by point; none for a point without an observation


def _plan(one: Map) -> _Plan:
    if not (one.keyframes and one.points):
        return _Plan([_kept(k, k.points >= 0, k.descriptors) for k in one.keyframes], {}, [])
    ends = np.cumsum([len(k.points) for k in one.keyframes])
    ids = np.array([point.id for point in one.points])
    starts = ends - [len(k.points) for k in one.keyframes]
    rows, owners = orbslam3.observations(one, starts, ids, Counter())
    descriptors = np.concatenate([k.descriptors for k in one.keyframes])
    seen = np.concatenate([k.points for k in one.keyframes]) >= 0
    votes: dict[int, bytes] = {}
    if len(rows):
        vote = majority(Support(owners, descriptors[rows]))
        descriptors[rows] = vote.descriptors[np.searchsorted(vote.landmarks, owners)]
        votes = {int(i): d.tobytes() for i, d in zip(vote.landmarks, vote.descriptors, strict=True)}
        seen[rows] = True
    parts = zip(one.keyframes, np.split(seen, ends), np.split(descriptors, ends), strict=False)
    kept = [_kept(*part) for part in parts]
    new_rows = {k.id: part.new_row for k, part in zip(one.keyframes, kept, strict=True)}
    return _Plan(kept, new_rows, [votes.get(point.id) for point in one.points])


def _kept(keyframe: Keyframe, seen: NDArray[np.bool_], descriptors: NDArray[np.uint8]) -> _Kept:
    """A pair of images keeps all keypoints, and so does an image that would lose every one."""
    if len(keyframe.right) or not seen.any():
        seen = np.ones_like(seen)
    rows = np.flatnonzero(seen)
    new_row = {row: i for i, row in enumerate(rows.tolist())}
    return _Kept(rows, descriptors[rows], new_row, len(seen) - len(rows))


class _AtlasWriter(AtlasReader):
    """Reads an atlas and collects the bytes of the new one."""

    def __init__(self, data: bytes, path: Path, plans: list[_Plan]) -> None:
        super().__init__(data, path)
        self._pieces: list[Any] = []
        self._copied = 0
        self._keyframes = iter([kept for plan in plans for kept in plan.keyframes])
        self._points = iter([(plan.new_rows, vote) for plan in plans for vote in plan.voted])
        # Of the keyframe or point that is being read.
        self._kept: _Kept | None = None
        self._new_rows: dict[int, dict[int, int]] = {}
        self._vote: bytes | None = None

    def written(self) -> list[Any]:
        """The new atlas in pieces."""
        self.atlas()
        return [*self._pieces, self.data[self._copied :]]

    def _replace(self, begin: int, *pieces: Any) -> None:
        """Write `pieces` in place of the bytes from `begin` to here."""
        self._pieces += [self.data[self._copied : begin], *pieces]
        self._copied = self.offset

    def _keyframe(self) -> Keyframe:
        self._kept = next(self._keyframes)
        return super()._keyframe()

    def _count(self) -> int:
        count, kept = super()._count(), self._kept
        if kept:
            self._replace(self.offset - 4, struct.pack("<i", len(kept.rows)))
        return count

    def _keypoints(self) -> NDArray[Any]:
        begin, keypoints = self.offset, super()._keypoints()
        self._keep(begin, "<i", keypoints)
        return keypoints

    def _per_keypoint(self, dtype: str) -> NDArray[Any]:
        begin, numbers = self.offset, super()._per_keypoint(dtype)
        self._keep(begin, "<Q", numbers)
        return numbers

    def _keep(self, begin: int, count: str, items: NDArray[Any]) -> None:
        """Write the kept ones of the items, one per keypoint or none, that were read."""
        if not (self._kept and self._kept.dropped and len(items)):
            return
        fits = len(items) == len(self._kept.rows) + self._kept.dropped
        self.expect(fits, f"{len(items):,} items are not one per keypoint")
        remaining = items[self._kept.rows]
        self._replace(begin, struct.pack(count, len(remaining)), remaining.tobytes())

    def _descriptors(self) -> NDArray[Any]:
        begin, descriptors = self.offset, super()._descriptors()
        size = descriptors.nbytes
        if self._kept and len(descriptors):
            columns, _, kind, continuous = struct.unpack_from("<3iB", self.data, begin)
            head = struct.pack("<3iB", columns, len(self._kept.rows), kind, continuous)
            self._replace(begin, head, self._kept.descriptors.tobytes())
        elif self._vote and size == len(self._vote):
            self._replace(self.offset - size, self._vote)
        return descriptors

    def _keypoints_of_node(self) -> NDArray[np.uint32]:
        begin, rows = self.offset, super()._keypoints_of_node()
        if self._kept and self._kept.dropped:
            new = self._kept.renumbered(rows.tolist())
            self._replace(begin, struct.pack(f"<Q{len(new)}I", len(new), *new))
        return rows

    def _grid(self) -> None:
        super()._grid()
        self._kept = None  # the rest of a keyframe is of its right image

    def skip_vectors(self, count: int) -> None:
        """Of the grid: those of a column's cells."""
        begin = self.offset
        super().skip_vectors(count)
        if self._kept and self._kept.dropped:
            words, at = self.data[begin : self.offset].cast("Q").tolist(), 0
            new: list[int] = []
            while at < len(words):
                end = at + 1 + words[at]
                rows = self._kept.renumbered(words[at + 1 : end])
                new += [len(rows), *rows]
                at = end
            self._replace(begin, struct.pack(f"<{len(new)}Q", *new))

    def _point(self) -> Point:
        self._new_rows, self._vote = next(self._points)
        point = super()._point()
        self._vote = None
        return point

    def _named(self) -> memoryview:
        named = super()._named()
        entries = np.frombuffer(named, NAMED).copy()
        new = [self._new_rows.get(keyframe, {}).get(row, row) for keyframe, row in entries.tolist()]
        entries["row"] = new
        self._replace(self.offset - len(named), entries.tobytes())
        return named
