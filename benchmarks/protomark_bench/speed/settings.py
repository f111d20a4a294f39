"""Settings of a bench: sections, sizes and time."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from protomark_bench.speed.race import Pace

GRAPHS = ("faiss", "faiss-lists", "hnswlib", "usearch-int8", "usearch-float32")
SECTIONS = ("encode", "search", "hamming", "approximate", "real", "frame", "add", "growth", "large")


@dataclass(frozen=True)
class BenchSettings:
    """Sizes and time.

    Attributes:
        sections: sections to measure.
        threads: threads of every contender, unless a section has its own.
        build_threads: threads to build indexes and data on, which is not compared.
        pace: pace of the races.
        encoded: number of descriptors in a whole set.
        queries: number of queries per search.
        trial: limit on the seconds of a trial of an index's setting.
        exact: numbers of landmarks for exact searches.
        approximate: numbers of landmarks for approximate searches.
        lsh_limit: limit on the landmarks for FLANN's LSH.
        graphs: names of `GRAPHS` to race, if memory suffices.
        graphs_limit: limit on the synthetic landmarks for all of them, beyond which only hnswlib
            is raced.
        map: number of landmarks in the map of the sections frame and add.
        growth: numbers of landmarks of the maps along the curve.
        large: number of landmarks in the largest map, 0 for none.
        indexes: folder that caches peers' indexes, None for no cache.
    """

    sections: tuple[str, ...] = SECTIONS
    threads: int = 1
    build_threads: int = 1
    pace: Pace = field(default_factory=Pace)
    encoded: int = 20_000
    queries: int = 1_000
    trial: float = 3.0
    exact: tuple[int, ...] = (10_000, 100_000, 1_000_000)
    approximate: tuple[int, ...] = (100_000, 1_000_000)
    lsh_limit: int = 100_000
    graphs: tuple[str, ...] = GRAPHS
    graphs_limit: int = 100_000
    map: int = 1_000_000
    growth: tuple[int, ...] = (10_000, 30_000, 100_000, 300_000, 1_000_000)
    large: int = 0
    indexes: Path | None = None

    def at(self, landmarks: tuple[int, ...]) -> BenchSettings:
        """These settings with maps of these sizes, and all graphs at any of them.

        Raises:
            ValueError: a map would have no landmark.
        """
        if not landmarks:
            return self
        if min(landmarks) < 1:
            raise ValueError(f"--landmarks {min(landmarks)}: give at least 1")
        sizes = tuple(sorted(set(landmarks)))
        named = self.sections != SECTIONS and "large" in self.sections
        return replace(
            self,
            exact=sizes,
            approximate=sizes,
            growth=sizes,
            map=sizes[-1],
            graphs_limit=sizes[-1],
            large=sizes[-1] if self.large or named else 0,
        )

    def with_graphs(self, graphs: str) -> BenchSettings:
        """These settings with the graphs that `--graphs` names, at any size.

        Raises:
            ValueError: there is no such graph.
        """
        if graphs == "all":
            return self
        names = () if graphs == "none" else tuple(graphs.split(","))
        for name in names:
            if name not in GRAPHS:
                names_text = ", ".join(GRAPHS)
                raise ValueError(f"--graphs {name}: no such graph ({names_text}; all, none)")
        return replace(self, graphs=names, graphs_limit=max(self.approximate))


def settings_of(
    scale: str, sections: tuple[str, ...], threads: int, **more: object
) -> BenchSettings:
    """Settings of the scale "usual", "quick" (seconds, for tests) or "full" (hours).

    Raises:
        ValueError: a section or the scale is unknown.
    """
    for name in sections:
        if name not in SECTIONS:
            raise ValueError(f"--only {name}: no such section ({', '.join(SECTIONS)})")
    usual = BenchSettings(sections=sections or SECTIONS, threads=threads, **more)  # type: ignore[arg-type]
    if scale == "usual":
        return usual
    if scale == "quick":
        return replace(
            usual,
            pace=Pace(rounds=3, shortest=0, longest=0.02),
            encoded=2_000,
            queries=100,
            trial=0.05,
            exact=(1_000, 3_000),
            approximate=(3_000,),
            map=3_000,
            growth=(1_000, 3_000),
            large=3_000,
        )
    if scale == "full":
        return replace(
            usual,
            approximate=(100_000, 1_000_000, 10_000_000),
            lsh_limit=1_000_000,
            graphs_limit=1_000_000,
            growth=(*usual.growth, 3_000_000, 10_000_000),
            large=100_000_000,
        )
    raise ValueError(f"--scale {scale}: give quick, usual or full")
