"""What a bench is asked to do."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from protomark.bench.race import Pace

GRAPHS = ("faiss", "faiss-cells", "hnswlib", "usearch-int8", "usearch-float32")

SECTIONS = (
    "encode",
    "search",
    "hamming",
    "approximate",
    "real",
    "frame",
    "add",
    "growth",
    "large",
)


@dataclass(frozen=True)
class Settings:
    """Sizes and time.

    Attributes:
        sections: what to measure.
        threads: of every contender, where a section does not say otherwise.
        build_threads: to build indexes and data with, which is not compared.
        dim: length of a code.
        pace: of races.
        encoded: descriptors of a whole set.
        queries: of every search.
        tuned_on: seconds that a trial of a setting may take.
        exact: landmarks of exact searches.
        approximate: landmarks of approximate searches.
        hashed: most landmarks whose bits go into FLANN's LSH.
        graphs: which of `GRAPHS` are raced, memory allowing.
        graphs_to: most grown landmarks for which all these are; beyond it only hnswlib's.
        map: landmarks of the map of the sections frame and add.
        growth: landmarks of the maps along the curve.
        large: landmarks of the largest map, 0 for none.
        scratch: folder for maps that are sealed and thrown away.
        indexes: folder where peers' indexes that took long to build are kept, None for nowhere.
    """

    sections: tuple[str, ...] = SECTIONS
    threads: int = 1
    build_threads: int = 1
    dim: int = 32
    pace: Pace = field(default_factory=Pace)
    encoded: int = 20_000
    queries: int = 1_000
    tuned_on: float = 3.0
    exact: tuple[int, ...] = (10_000, 100_000, 1_000_000)
    approximate: tuple[int, ...] = (100_000, 1_000_000)
    hashed: int = 100_000
    graphs: tuple[str, ...] = GRAPHS
    graphs_to: int = 100_000
    map: int = 1_000_000
    growth: tuple[int, ...] = (10_000, 30_000, 100_000, 300_000, 1_000_000)
    large: int = 0
    scratch: Path = Path()
    indexes: Path | None = None


def choose(
    *,
    sections: tuple[str, ...],
    threads: int,
    build_threads: int,
    full: bool,
    quick: bool,
    scratch: Path,
    landmarks: tuple[int, ...] = (),
    graphs: tuple[str, ...] | None = None,
    indexes: Path | None = None,
) -> Settings:
    """The settings of `--full`, of `--quick` (a few seconds, for tests), or of neither.

    `landmarks` are sizes of the maps that are searched, in place of these settings' own. `graphs`
    that are named, and all if sizes are, are raced at any size; else only hnswlib's is at large
    ones.

    Raises:
        ValueError: a section or a graph is unknown, both are asked for, or a map has no landmark.
    """
    chosen = _of_scale(sections, threads, build_threads, full, quick, scratch)
    chosen = replace(chosen, indexes=indexes)
    if graphs is not None:
        strange = [name for name in graphs if name not in GRAPHS]
        if strange:
            known = ", ".join(GRAPHS)
            raise ValueError(f"--graphs {strange[0]}: no such graph ({known}; all, none)")
        chosen = replace(chosen, graphs=graphs, graphs_to=max(chosen.approximate))
    if any(n < 1 for n in landmarks):
        raise ValueError(f"--landmarks {min(landmarks)}: a map needs at least 1")
    if not landmarks:
        return chosen
    sizes = tuple(sorted(set(landmarks)))
    large = sizes[-1] if "large" in sections else chosen.large
    return replace(
        chosen,
        exact=sizes,
        approximate=sizes,
        growth=sizes,
        graphs_to=sizes[-1],
        large=large,
    )


def _of_scale(
    sections: tuple[str, ...],
    threads: int,
    build_threads: int,
    full: bool,
    quick: bool,
    scratch: Path,
) -> Settings:
    unknown = [name for name in sections if name not in SECTIONS]
    if unknown:
        raise ValueError(f"--only {unknown[0]}: no such section ({', '.join(SECTIONS)})")
    if full and quick:
        raise ValueError("give --full or --quick, not both")
    default = Settings(
        sections=sections or SECTIONS,
        threads=threads,
        build_threads=build_threads,
        scratch=scratch,
    )
    if quick:
        return replace(
            default,
            pace=Pace(rounds=3, shortest=0, longest=0.05),
            encoded=2_000,
            queries=100,
            tuned_on=0.2,
            exact=(1_000, 3_000),
            approximate=(3_000,),
            map=3_000,
            growth=(1_000, 3_000),
            large=3_000,
        )
    if full:
        return replace(
            default,
            approximate=(100_000, 1_000_000, 10_000_000),
            hashed=1_000_000,
            graphs_to=1_000_000,
            growth=(*default.growth, 3_000_000, 10_000_000),
            large=100_000_000,
        )
    return default
