"""The tables of a bench, for the terminal and for Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

from protomark.bench.results import Contest, Results
from protomark.bench.targets import EQUIVALENT, Outcome, duration, factor, outcomes, share_text

if TYPE_CHECKING:
    from rich.table import Table

HEADS = ("what", "ours", "peer", "ratio (spread)", "target", "met")
_SECTIONS = {
    "encode": (
        "Encoding",
        "The shipped networks, cut to the length given. Peers compute the same network, made from "
        "the encoder's own layers, and get bits that are already unpacked (float32, for int8 "
        "uint8); unpacking them is not counted. ONNX Runtime int8 is quantised at the encoder's "
        "own scales, statically (QDQ, fused to QGemm) and dynamically; the target is held against "
        "the faster one. The multiply-adds of the network are counted, though ours looks up sums "
        "in tables in place of the first layer's: what its speed is worth in multiply-adds is an "
        "equivalent, no share, and may pass 100 % of the ceiling. Whatever descriptor the tracks "
        "are not of has random bits.",
    ),
    "search": (
        "Exact search of prototypes",
        "1,000 queries, k = 2, encoded beforehand. Multiply-adds are landmarks × dimensions, "
        "though ours compares most landmarks in the first dimensions only: what its speed is "
        "worth is an equivalent, no share, and may pass 100 % of the ceiling.",
    ),
    "hamming": (
        "Exact search of all descriptors",
        "The map's unaggregated descriptors searched by Hamming distance, beside its prototypes. "
        "Slow contenders get fewer queries; times are per query.",
    ),
    "approximate": (
        "Approximate search",
        "Each index at the fastest of its settings whose recall@1, against the exact answer, is "
        "high enough; answers at the same distance count as right. That setting is chosen on the "
        "queries that are timed, for all alike; a map that is asked for a recall chooses on test "
        "queries of its own, and searches somewhat more (Growth). Slow settings are asked fewer "
        "queries, as stated. Bytes are those of the whole serialised index; building has its own "
        "number of threads, and what `--indexes` keeps was built before. What searches other rows "
        "than prototypes has no ratio. Peers that were not raced, or do not find enough, are "
        "listed at the end.",
    ),
    "real": (
        "Approximate search of real landmarks",
        "The same with the tracks' own landmarks, none grown; queries are their observations that "
        "no prototype holds.",
    ),
    "frame": ("A whole frame", "One call of `search` with descriptors and a ratio."),
    "add": ("Adding observations", "Random landmarks, all in the map; beside encoding alone."),
}


def markdown(results: Results, plots: Sequence[str] = ()) -> str:
    """The whole report; `plots` are names of pictures beside it."""
    parts = [
        "# Benchmarks",
        f"Protomark beside its peers, and the ceilings of the machine: {_runs(results)}, the same "
        "data, the same number of threads. To repeat it (docs/tracks.md says where tracks come "
        "from):",
        f"    pip install protomark[bench]\n    {results.command}",
        "## Targets",
        "Ratios are how many times as fast ours is: median of the rounds, least to greatest in "
        "brackets. In a round every contender runs once, one after the other. Times are of one "
        "descriptor, query or observation, medians of the rounds; a turn too short to time is "
        "repeated, and the median of its repetitions counts. Rows of another size "
        "than the target's are not held against it.",
        markdown_table(HEADS, [outcome_cells(row) for row in outcomes(results)]),
        *(f"![{PurePosixPath(name).stem}]({name})" for name in plots),
        "## Machine and data",
        bullets([f"{name}: {text}" for name, text in {**results.machine, **results.data}.items()]),
        "Ceilings of one thread, measured in the same run:",
        bullets(ceilings(results)),
    ]
    if results.interrupted:
        parts.insert(1, "**The run ended early; what is missing was not measured.**")
    if results.resemblance:
        parts += [
            "### Grown data beside real data",
            "Recall@1 of FAISS with the same parameters, on as many landmarks:",
            markdown_table(
                ("index", "real", "grown"),
                [
                    [name, f"{real:.3f}", f"{grown:.3f}"]
                    for name, (real, grown) in results.resemblance.items()
                ],
            ),
        ]
    for section, (title, text) in _SECTIONS.items():
        contests = [contest for contest in results.contests if contest.section == section]
        if contests:
            parts += [f"## {title}", text]
        for contest in contests:
            parts += [f"**{caption(results, contest)}**", contest_table(contest)]
    if results.growth:
        parts += ["## Growth", _GROWTH, growth_table(results)]
    if results.large:
        parts += [
            "## The largest map",
            _LARGEST,
            markdown_table(
                ("what", "value"), [[name, f"{v:,.4g}"] for name, v in results.large.items()]
            ),
        ]
    if results.skipped:
        parts += ["## Left out", bullets(results.skipped)]
    return "\n\n".join(parts) + "\n"


_GROWTH = (
    "One of 1,000 queries, k = 2. Approximate: the map is asked for a recall of 0.98, and chooses "
    "how much it searches itself. Memory is what the process has allocated for an open map, with "
    "what its vectors hold in reserve; of it the index, which is what dropping it gives back."
)
_LARGEST = (
    "Two threads, a recall of 0.95 asked for; observations kept out are the queries. Four bits "
    "round the prototypes: how often a search finds what is nearest in this file, what is "
    "nearest among the prototypes of 8 bits, and the landmark that the query is of."
)


def rich_table(results: Results) -> Table:
    """The targets, for a terminal."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, show_edge=False)
    for head in HEADS:
        table.add_column(head, overflow="fold")
    before = ""
    for row in outcomes(results):
        what, *rest = [text.replace("**", "") for text in outcome_cells(row)]
        table.add_row(
            "" if what == before else what,
            *rest,
            style={True: "green", False: "red", None: ""}[row.met],
        )
        before = what
    return table


def outcome_cells(row: Outcome) -> list[str]:
    """One target as text."""
    met = {True: "yes", False: "**no**", None: "–"}[row.met]
    return [row.what, row.ours, row.peer, row.ratio, row.target, met]


def caption(results: Results, contest: Contest) -> str:
    """What was done, on how many threads, and how near the ceiling ours came."""
    text = f"{contest.title}; {contest.threads} thread{'s' if contest.threads != 1 else ''}"
    share = results.share(contest)
    if share is None:
        return text
    return (
        f"{text}; ours {'' if contest.section in EQUIVALENT else 'at '}{share_text(contest, share)}"
    )


def contest_table(contest: Contest) -> str:
    """All contenders of a contest, with those facts that any of them has."""
    facts = {
        "recall": ("recall@1", ".3f"),
        "asked": ("on queries", ",.0f"),
        "bytes": ("bytes a landmark", ",.1f"),
        "more": ("of them for the index", ",.2f"),
        "build": ("built in s", ",.1f"),
    }
    shown = [key for key in facts if any(key in t.facts for t in contest.timings)]
    notes = any(timing.note for timing in contest.timings)
    heads = [
        "contender",
        f"a {contest.unit}",
        "ours is faster by",
        f"{plural(contest.unit)} a call",
        *(facts[key][0] for key in shown),
        *(["how"] if notes else []),
    ]
    rows = []
    for timing in contest.timings:
        ratio = contest.ratio(timing)
        rows.append(
            [
                f"**{timing.name}**" if timing.ours else timing.name,
                duration(timing.median),
                "–" if ratio is None else factor(ratio),
                f"{timing.units:,}",
                *(
                    format(timing.facts[key], facts[key][1]) if key in timing.facts else "–"
                    for key in shown
                ),
                *([timing.note or "–"] if notes else []),
            ]
        )
    return markdown_table(heads, rows)


def growth_table(results: Results) -> str:
    """Every point of the curves."""
    rows = [
        [
            f"{p['landmarks']:,}",
            p["method"],
            duration(p["seconds"]),
            f"{p['file']:.1f}, sealed"
            if "file" in p
            else "–"
            if p["bytes"] is None
            else f"{p['bytes']:,.0f}",
            f"{p['index']:.2f}" if "index" in p else "–",
            f"{p['recall']:.3f}",
            f"{p['build']:.1f}" if "build" in p else "–",
        ]
        for p in results.growth
    ]
    heads = (
        "landmarks",
        "search",
        "a query",
        "bytes a landmark, open map",
        "of them for the index",
        "recall@1",
        "index, s",
    )
    return markdown_table(heads, rows)


def ceilings(results: Results) -> list[str]:
    """The machine's limits as text."""
    return [
        f"reading memory: {rate / 1e9:.1f} GB/s"
        if name == "read"
        else f"int8 multiply-adds, {name}: {rate / 1e9:,.0f} × 10⁹ a second"
        for name, rate in results.ceilings.items()
    ]


def _runs(results: Results) -> str:
    """How often it was measured: results may be joined."""
    runs = 1 + results.command.count("\n")
    return "one run" if runs == 1 else f"{runs} runs on one machine, each contest within one"


def plural(unit: str) -> str:
    """queries, descriptors, frames."""
    return unit[:-1] + "ies" if unit.endswith("y") else unit + "s"


def bullets(texts: Sequence[str]) -> str:
    """A Markdown list."""
    return "\n".join(f"- {text}" for text in texts)


def markdown_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A GitHub table."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
