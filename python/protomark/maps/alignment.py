"""Brings a map into the world of another by what their prototypes have in common."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.geometry.neighbours import cube_numbers, near_points
from protomark.geometry.similarity import Array, Similarity, find_similarity
from protomark.matching import MIN_PROBABILITY

Ids = NDArray[np.int64]

# So many landmarks, spread evenly over a larger map, are searched in the other one; so many of the
# likeliest pairs vote for the similarity.
MAX_SEARCHED = 20_000
_MAX_VOTING = 5_000
# Pairs agree within one of these shares of a map's reach: drift and errors in depth differ.
_LIMITS = (0.0025, 0.005, 0.01, 0.02, 0.04)
# Landmarks are in one place if they are in the same cube, with edges of so many limits.
_CELL = 8.0
# Two maps are of one scene if so many pairs agree, and chance does that at most so often (log10);
# if of the likely pairs with one end where the other map has landmarks this share agrees; and if
# this share of the cubes in which both maps have landmarks holds a pair that agrees
# (benchmarks/scripts/merge_halves.py). Places that only look alike share some landmarks, and lack
# those around them.
_MIN_AGREEING = 15
_MAX_CHANCE = -12.0
_MIN_SHARE = 0.15
_MIN_CUBES = 0.1
_SAMPLES = 200_000
# A flat scene agrees with its mirror image, too, but hardly more.
_MIRRORED = 1.1
# Duplicates are as much alike as this share of the pairs that agree, and more than all but this
# share of landmarks without relation.
_ALIKE, _UNRELATED = 0.95, 0.01


@dataclass(frozen=True)
class Alignment:
    """How a map lies in another one's world, and what says so.

    Attributes:
        similarity: moves its positions there.
        into: (n,) int64, landmarks of the other map.
        source: (n,) int64, the same landmarks in this map.
        radius: how far apart moved positions of one landmark are, in the other world.
        drift: how far it moves landmarks that are likely in both (median).
        reach: median distance of the other map's landmarks from their middle.
        likely: number of pairs of landmarks that are likely to be the same by their prototypes and
            have one end where the other map has landmarks.
        agreeing: how many of these agree with the similarity.
        chance: log10 of how many such agreeing sets maps of different scenes would give.
        cubes: number of cubes of space in which both maps have landmarks, of this map such as were
            searched in the other one.
        cube_share: share of these that hold a pair that agrees.
    """

    similarity: Similarity
    into: Ids
    source: Ids
    radius: float
    drift: float
    reach: float
    likely: int
    agreeing: int
    chance: float
    cubes: int
    cube_share: float

    @property
    def stays(self) -> bool:
        """Whether the map is in the other one's world already."""
        return self.drift <= self.radius

    @property
    def is_significant(self) -> bool:
        """Whether chance alone does not explain the pairs that agree."""
        return self.agreeing >= _MIN_AGREEING and self.chance <= _MAX_CHANCE

    @property
    def problem(self) -> str:
        """Why the maps may be of different places, "" if they are of one."""
        share = self.agreeing / max(self.likely, 1)
        if not self.is_significant:
            return f"only {self.agreeing} landmarks agree on how they lie in each other"
        if share < _MIN_SHARE:
            return (
                f"of {self.likely:,} landmarks that look alike only {share:.0%} agree on how the "
                "maps lie in each other: these places may only look alike"
            )
        if self.cube_share < _MIN_CUBES:
            return (
                f"laid over each other by the {self.agreeing:,} landmarks that agree, the maps "
                f"have other landmarks all around these ({self.cube_share:.0%} of the space that "
                "both show holds common ones): these places may only look alike"
            )
        return ""

    def facts(self) -> dict[str, Any]:
        """The evidence as JSON values."""
        return {
            "scale": self.similarity.scale,
            "degrees": self.similarity.degrees,
            "translation": self.similarity.translation.tolist(),
            "likely": self.likely,
            "agreeing": self.agreeing,
            "log10_chance": round(self.chance, 1),
            "cubes": self.cubes,
            "cube_share": self.cube_share,
            "duplicates": len(self.into),
        }


def align_maps(
    target: pm.PrototypeMap,
    source: pm.PrototypeMap,
    fixed_scale: bool = False,
    threads: int = 1,
    searched: int = MAX_SEARCHED,
) -> Alignment:
    """How `source` lies in the world of `target`; see `Alignment.problem` before you believe it.

    At most `searched` landmarks, spread evenly over the map, are searched in the other one.

    Raises:
        ValueError: the encoder has no match calibration, the maps have other encoders or
            dimensions, too few landmarks with positions, or nothing agrees.
    """
    if target.encoder.identity != source.encoder.identity or target.dim != source.dim:
        raise ValueError("maps of different encoders or dimensions cannot be merged")
    worlds = _World.of(target), _World.of(source)
    for world in worlds:
        if len(world.ids) < _MIN_AGREEING or not world.reach > 0:
            raise ValueError(
                f"{len(world.ids)} landmarks of a map have a position, too few, or all the same, "
                "to find out how maps lie in each other"
            )
    sample = worlds[1].ids[:: -(-len(worlds[1].ids) // searched)]
    into, ours = _likely_pairs(*worlds, sample, threads)
    if len(into) < _MIN_AGREEING:
        raise ValueError(f"only {len(into)} landmarks look alike: the maps are of different places")
    to, start = target.positions(into), source.positions(ours)
    found, mirrored = (
        find_similarity(
            start[:_MAX_VOTING] * axes,
            to[:_MAX_VOTING],
            (worlds[1].reach, worlds[0].reach),
            _LIMITS,
            fixed_scale=fixed_scale,
            samples=samples,
        )
        for axes, samples in (((1, 1, 1), _SAMPLES), ((1, 1, -1), _SAMPLES // 20))
    )
    proper = _MAX_CHANCE if found is None else min(_MAX_CHANCE, _MIRRORED * found.chance)
    if mirrored is not None and mirrored.chance < proper:
        raise ValueError("of the two maps one is mirrored, so its coordinates are left-handed")
    if found is None:
        raise ValueError(
            f"of {len(into):,} landmarks that look alike too few agree on how the maps lie in each "
            "other: they are of different places, or show too little of the same"
        )
    motion = found.similarity
    radius = found.limit * min(worlds[0].reach, motion.scale * worlds[1].reach)
    agrees = np.linalg.norm(motion(start) - to, axis=1) <= radius
    edge = _CELL * radius
    ends = [cube_numbers(np.floor(p / edge)) for p in (to, motion(start))]
    every = (worlds[0].positions, motion(worlds[1].positions), motion(source.positions(sample)))
    cubes = [cube_numbers(np.floor(p / edge)) for p in every]
    near_other = np.isin(ends[0], cubes[1]) | np.isin(ends[1], cubes[0])
    both = np.intersect1d(cubes[0], cubes[2])
    held = np.isin(both, np.concatenate([end[agrees] for end in ends]))
    duplicates = _duplicates(*worlds, motion, radius, into[agrees], ours[agrees])
    return Alignment(
        motion,
        *duplicates,
        radius,
        float(np.median(np.linalg.norm(motion(start) - start, axis=1))),
        worlds[0].reach,
        int((near_other | agrees).sum()),
        int(agrees.sum()),
        found.chance,
        len(both),
        float(held.mean()) if len(both) else 0.0,
    )


@dataclass(frozen=True)
class _World:
    scene: pm.PrototypeMap
    ids: Ids  # landmarks with a position
    positions: Array
    reach: float  # median distance from the middle

    @classmethod
    def of(cls, scene: pm.PrototypeMap) -> _World:
        ids = scene.ids
        positions = scene.positions(ids)
        placed = np.isfinite(positions).all(axis=1)
        ids, positions = ids[placed], positions[placed]
        middle = np.median(positions, axis=0) if len(ids) else np.zeros(3)
        distances = np.linalg.norm(positions - middle, axis=1)
        return cls(scene, ids, positions, float(np.median(distances)) if len(ids) else 0.0)

    def codes(self, ids: Ids) -> NDArray[np.int8]:
        """Prototypes as codes (n, dim); a mean of codes is one for search."""
        return np.rint(self.scene.prototypes(ids)).astype(np.int8)

    def nearest(self, codes: NDArray[np.int8], threads: int) -> tuple[Ids, Array]:
        """The nearest landmark of each code (n, dim), and the probability that it is right."""
        found, distances = self.scene.search_codes(codes, k=2, threads=threads)
        calibration = self.scene.encoder.match_calibration(self.scene.dim)
        return found[:, 0], calibration.probability(distances)


def _likely_pairs(target: _World, source: _World, searched: Ids, threads: int) -> tuple[Ids, Ids]:
    """Landmarks of the target, and those of the searched that are likely the same, best first.

    They are each other's nearest.
    """
    there, forth = target.nearest(source.codes(searched), threads)
    likely = (forth >= MIN_PROBABILITY) & np.isin(there, target.ids)
    searched, there, forth = searched[likely], there[likely], forth[likely]
    again, back = source.nearest(target.codes(there), threads)
    both = forth * back
    mutual = np.flatnonzero((again == searched) & (back >= MIN_PROBABILITY))
    best = mutual[np.argsort(-both[mutual], kind="stable")]
    return there[best], searched[best]


def _duplicates(
    target: _World, source: _World, motion: Similarity, radius: float, into: Ids, ours: Ids
) -> tuple[Ids, Ids]:
    """Landmarks of both maps that are the same: near, alike, and each other's most alike near one.

    Pairs that agree with the motion, `into` and `ours`, are among them, and say how much alike is
    enough.
    """
    pairs = target.scene.distances(into, source.codes(ours))
    unrelated = target.scene.distances(np.roll(into, len(into) // 2), source.codes(ours))
    limit = min(np.quantile(pairs, _ALIKE), np.quantile(unrelated, _UNRELATED))
    rows, near = near_points(motion(source.positions), target.positions, radius)
    rows, near = source.ids[rows], target.ids[near]
    free = ~(np.isin(rows, ours) | np.isin(near, into))
    rows, near = rows[free], near[free]
    alike = target.scene.distances(near, source.codes(rows))
    kept = np.flatnonzero(alike <= limit)
    order = kept[np.lexsort((near[kept], rows[kept], alike[kept]))]
    rows, near = rows[order], near[order]
    first, second = (np.zeros(len(rows), bool) for _ in range(2))
    first[np.unique(rows, return_index=True)[1]] = True
    second[np.unique(near, return_index=True)[1]] = True
    best = first & second
    return np.concatenate([into, near[best]]), np.concatenate([ours, rows[best]])
