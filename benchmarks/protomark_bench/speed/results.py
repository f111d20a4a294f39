"""Results of a bench, as JSON and as a page."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from protomark_bench import plot
from protomark_bench.report import (
    Part,
    Report,
    ReportTable,
    bullets,
    duration,
    facts,
    load_json,
    number,
    picture,
)
from protomark_bench.speed.race import Contest, Timing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAME, FORMAT, VERSION = "benchmarks", "protomark-bench", 1
DRAWN_RECALL = 0.99  # recall of the approximate searches in the plot of ratios

# Sections in which ours does fewer multiply-adds than count as its work.
_EQUIVALENT = ("encode", "search", "hamming")
_SECTIONS = {
    "encode": (
        "Encoding",
        "The shipped networks, cut to the length given. Peers compute the same network, made from "
        "the encoder's own layers, and get bits that are already unpacked (float32, for int8 "
        "uint8); unpacking is not counted. ONNX Runtime int8 is quantised at the encoder's own "
        "scales, statically (QDQ, fused to QGemm) and dynamically. The share of the ceiling counts "
        "the multiply-adds of the whole network. Protomark looks up sums in tables in place of the "
        "first layer's, so the share is an equivalent and may pass 100 %. An encoder whose "
        "descriptor the tracks do not have gets random bits.",
    ),
    "search": (
        "Exact search of prototypes",
        "1,000 queries, k = 2, encoded beforehand. The share of the ceiling counts landmarks × "
        "dimensions multiply-adds. Protomark compares most landmarks in their first dimensions "
        "only, so the share is an equivalent and may pass 100 %.",
    ),
    "hamming": (
        "Exact search of all descriptors",
        "The map's unaggregated descriptors searched by Hamming distance, beside its prototypes. "
        "Slow contenders get fewer queries; times are per query.",
    ),
    "approximate": (
        "Approximate search",
        "Each index at the fastest of its settings whose recall@1, against the exact answer, is "
        "high enough; answers at the same distance count as right. For every index alike that "
        "setting is chosen on the queries that are timed. A map that is asked for a recall chooses "
        "on test queries of its own, and searches somewhat more (see Growth). Slow settings are "
        "asked fewer queries, as stated. Bytes are those of the whole serialised index. Building "
        "uses all threads; what `--indexes` caches was built before. An index that searches other "
        "rows than prototypes has no ratio. The end of this page lists peers that were not raced "
        "or do not find enough.",
    ),
    "real": (
        "Approximate search of real landmarks",
        "The same with the tracks' own landmarks; queries are their observations that no prototype "
        "holds.",
    ),
    "frame": ("A whole frame", "One call of `search` with descriptors and a ratio."),
    "add": ("Adding observations", "Random landmarks, all in the map; beside encoding alone."),
}
_GROWTH = (
    "Time per query of 1,000 queries, k = 2. Approximate: the map is asked for a recall of 0.98, "
    "and chooses how much it searches. Memory is what the process has allocated for a learning "
    "map, with what its arrays hold in reserve; the index's part is what dropping it gives back."
)
_LARGEST = (
    "Two threads, a recall of 0.95 asked for; held-out observations are the queries. Four bits "
    "round the prototypes: how often a search finds what is nearest in this file, what is nearest "
    "among int8 prototypes, and the landmark that the query observes."
)
_FACTS = {
    "recall": ("recall@1", ".3f"),
    "asked": ("on queries", ",.0f"),
    "bytes": ("bytes per landmark", ",.1f"),
    "more": ("of them for the index", ",.2f"),
    "build": ("built in s", ",.1f"),
}


@dataclass
class BenchResults:
    """All results of a run.

    Attributes:
        machine: CPU, instruction set, versions and so on, by name.
        data: descriptions of the data, by name.
        ceilings: see `machine.ceilings`.
        contests: contests in their order.
        resemblance: recall of FAISS on real and on synthetic landmarks, by index.
        growth: points {landmarks, method, seconds (per query), bytes (per landmark), ...}.
        large: figures of the largest map by name; empty without one.
        skipped: measurements that were left out, and why.
        interrupted: whether the run ended early.
        command: the command line that repeats the run.
    """

    machine: dict[str, str] = field(default_factory=dict)
    data: dict[str, str] = field(default_factory=dict)
    ceilings: dict[str, float] = field(default_factory=dict)
    contests: list[Contest] = field(default_factory=list)
    resemblance: dict[str, list[float]] = field(default_factory=dict)
    growth: list[dict[str, Any]] = field(default_factory=list)
    large: dict[str, float] = field(default_factory=dict)
    skipped: list[str] = field(default_factory=list)
    interrupted: bool = False
    command: str = "protomark bench"

    @classmethod
    def load(cls, path: Path) -> BenchResults:
        """Reads the JSON of a report.

        Raises:
            FileNotFoundError, ValueError: the file is missing or holds no such results.
        """
        values = load_json(path, FORMAT)
        contests = [
            Contest(**{**entry, "timings": [Timing(**t) for t in entry["timings"]]})
            for entry in values.pop("contests")
        ]
        return cls(contests=contests, **values)

    def as_dict(self) -> dict[str, Any]:
        """The results as JSON values."""
        return {"format": FORMAT, "version": VERSION, **asdict(self)}

    def share(self, contest: Contest) -> float | None:
        """Our share of the ceiling that applies to the contest's work, None without a ceiling.

        The ceiling of multiply-adds is that of the best vector instructions (not tiles) on all
        threads; the ceiling of bytes is that of one reading thread.
        """
        ours = contest.ours
        rates = [rate for name, rate in self.ceilings.items() if name not in ("read", "amx")]
        if ours is None:
            return None
        if "multiply_adds" in contest.work and rates:
            ceiling = max(rates) * contest.threads
            return contest.work["multiply_adds"] / ours.median / ceiling
        if "bytes" in contest.work and "read" in self.ceilings and contest.threads == 1:
            return contest.work["bytes"] / ours.median / self.ceilings["read"]
        return None

    def summary(self) -> ReportTable:
        """One row per contest, with ours and the fastest peer."""
        rows = []
        for contest in self.contests:
            ours = contest.ours
            others = [t for t in contest.timings if not t.ours and t.comparable]
            if ours is None:
                continue
            peer = min(others, key=lambda timing: timing.median, default=None)
            rows.append(
                [
                    f"{contest.section}: {contest.title}, {_threads(contest.threads)}",
                    duration(ours.median),
                    "–" if peer is None else f"{peer.name}: {duration(peer.median)}",
                    _ratio_text(None if peer is None else contest.ratio(peer)),
                ]
            )
        heads = ("contest", "Protomark", "fastest other contender", "ratio (spread)")
        return ReportTable(heads, rows, words=3)

    def report(self) -> Report:
        """The report: page, plots and JSON."""
        plots = {"ratios": draw_ratios(self), "growth": draw_growth(self)}
        drawn = {name: figure for name, figure in plots.items() if figure is not None}
        notes = [f"left out: {note}" for note in self.skipped]
        if self.interrupted:
            notes.append("interrupted: later sections were not measured")
        return Report(
            NAME,
            "protomark bench",
            self.as_dict(),
            self._parts(list(drawn)),
            drawn,
            [self.summary().rich()],
            notes,
        )

    def _parts(self, plots: list[str]) -> list[Part]:
        parts: list[Part] = [
            "# Benchmarks",
            "Protomark beside its peers and the ceilings of the machine: one run, the same data, "
            "the same number of threads. To repeat it "
            "([tracks](../tracks.md) come from `protomark tracks`):",
            f"    pip install . ./benchmarks\n    {self.command}",
            "**The run ended early, so later sections were not measured.**"
            if self.interrupted
            else "",
            "## Summary",
            "Ratios are how many times as fast Protomark is: median of the rounds, least to "
            "greatest in brackets. In a round every contender runs once, one after the other. "
            "Times are per descriptor, query, frame or observation, medians of the rounds; a turn "
            "too short to time is repeated, and the median of its repetitions counts.",
            self.summary(),
            *(picture(NAME, name, name) for name in plots),
            "## Machine and data",
            facts({**self.machine, **self.data}),
            "Ceilings of one thread, measured in the same run:",
            bullets(_ceiling_text(name, rate) for name, rate in self.ceilings.items()),
        ]
        if self.resemblance:
            rows = [
                [name, f"{real:.3f}", f"{synthetic:.3f}"]
                for name, (real, synthetic) in self.resemblance.items()
            ]
            parts += [
                "### Synthetic data beside real data",
                "Recall@1 of FAISS with the same parameters, on as many landmarks:",
                ReportTable(("index", "real", "synthetic"), rows),
            ]
        for section, (title, text) in _SECTIONS.items():
            contests = [contest for contest in self.contests if contest.section == section]
            if contests:
                parts += [f"## {title}", text]
            for contest in contests:
                parts += [f"**{self._caption(contest)}**", _contest_table(contest)]
        if self.growth:
            parts += ["## Growth", _GROWTH, _growth_table(self.growth)]
        if self.large:
            rows = [[name, f"{value:,.4g}"] for name, value in self.large.items()]
            parts += ["## The largest map", _LARGEST, ReportTable(("what", "value"), rows)]
        if self.skipped:
            parts += ["## Left out", bullets(self.skipped)]
        return parts

    def _caption(self, contest: Contest) -> str:
        text = f"{contest.title}; {_threads(contest.threads)}"
        share = self.share(contest)
        if share is None:
            return text
        ceiling = "vector" if "multiply_adds" in contest.work else "reading"
        worth = "worth" if contest.section in _EQUIVALENT else "at"
        return f"{text}; Protomark {worth} {100 * share:.0f} % of the {ceiling} ceiling"


def draw_ratios(results: BenchResults) -> Figure | None:
    """Draw the ratio of each peer's time to ours."""
    rows = []
    for contest in results.contests:
        if contest.section == "add" or contest.recall not in (None, DRAWN_RECALL):
            continue
        for peer in contest.timings:
            ratio = contest.ratio(peer)
            if ratio is not None and not peer.ours:
                rows.append((f"{contest.section}, {contest.title}: {peer.name}", ratio))
    if not rows:
        return None
    title = "Protomark is faster by a factor of"
    return plot.draw_ratios(rows, title, "peer's time / ours, same run, same threads (log)")


def draw_growth(results: BenchResults) -> Figure | None:
    """Draw time per query and memory against landmarks."""
    times, memory = [], []
    for method, color in (("exact", plot.TEAL), ("approximate", plot.AMBER)):
        points = [p for p in results.growth if p["method"] == method]
        sized = [p for p in points if p["bytes"] is not None]
        x = [p["landmarks"] for p in points]
        times.append(plot.Series(method, x, [1000 * p["seconds"] for p in points], color))
        mib = [p["bytes"] * p["landmarks"] / 2**20 for p in sized]
        memory.append(plot.Series(method, [p["landmarks"] for p in sized], mib, color))
    if not results.growth:
        return None
    if results.large:
        n = results.large["landmarks"]
        for form, color in (("int8", plot.VIOLET), ("words", plot.BLUE)):
            size = results.large[f"{form}: file bytes"] / 2**20
            memory.append(plot.Series(f"sealed file, {form}", [n], [size], color, "D"))
    return plot.draw_lines(
        [
            plot.Panel(title, "landmarks (log)", y, series, log="xy")
            for title, y, series in (
                ("Time against landmarks", "ms per query (log)", times),
                ("Memory against landmarks", "MiB, of the learning map (log)", memory),
            )
        ]
    )


def _contest_table(contest: Contest) -> ReportTable:
    """All contenders of a contest, with the facts that any of them has."""
    shown = [key for key in _FACTS if any(key in t.facts for t in contest.timings)]
    notes = any(timing.note for timing in contest.timings)
    heads = [
        "contender",
        f"per {contest.unit}",
        "Protomark is faster by",
        f"{_plural(contest.unit)} per call",
        *(_FACTS[key][0] for key in shown),
        *(["how"] if notes else []),
    ]
    rows = [
        [
            f"**{timing.name}**" if timing.ours else timing.name,
            duration(timing.median),
            _ratio_text(contest.ratio(timing)),
            f"{timing.units:,}",
            *(number(timing.facts.get(key), _FACTS[key][1]) for key in shown),
            *([timing.note or "–"] if notes else []),
        ]
        for timing in contest.timings
    ]
    return ReportTable(heads, rows)


def _growth_table(points: list[dict[str, Any]]) -> ReportTable:
    heads = (
        "landmarks",
        "search",
        "per query",
        "bytes per landmark, learning map",
        "of them for the index",
        "recall@1",
        "index built in s",
    )
    rows = [
        [
            f"{p['landmarks']:,}",
            p["method"],
            duration(p["seconds"]),
            f"{p['file']:.1f}, sealed" if "file" in p else number(p["bytes"], ",.0f"),
            number(p.get("index"), ".2f"),
            number(p["recall"]),
            number(p.get("build"), ".1f"),
        ]
        for p in points
    ]
    return ReportTable(heads, rows, words=2)


def _ceiling_text(name: str, rate: float) -> str:
    if name == "read":
        return f"reading memory: {rate / 1e9:.1f} GB/s"
    return f"int8 multiply-adds, {name}: {rate / 1e9:,.0f} × 10⁹ per second"


def _ratio_text(ratio: tuple[float, float, float] | None) -> str:
    return "–" if ratio is None else "{:.3g} ({:.3g} to {:.3g})".format(*ratio)


def _threads(count: int) -> str:
    return f"{count} thread{'s' if count != 1 else ''}"


def _plural(unit: str) -> str:
    return unit[:-1] + "ies" if unit.endswith("y") else unit + "s"
