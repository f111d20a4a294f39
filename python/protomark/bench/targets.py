"""What Protomark sets out to reach, and whether a run did."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import log

from protomark.bench.results import Contest, Ratio, Results, Timing

GOAL_SIZE = 1_000_000
# Sections in which ours does not do all multiply-adds that count as its work.
EQUIVALENT = ("encode", "search")


@dataclass(frozen=True)
class Outcome:
    """A row of the table: texts, and whether the target is met.

    Attributes:
        met: None where nothing was measured, or not at the target's size.
    """

    what: str
    ours: str = "–"
    peer: str = "–"
    ratio: str = "–"
    target: str = ""
    met: bool | None = None


def outcomes(results: Results) -> list[Outcome]:
    """All targets, in the order of the table."""
    return [
        *_encode(results),
        *_search(results),
        *_graphs(results),
        *_approximate(results),
        *_frame(results),
        *_add(results),
        *_large(results),
        *_growth(results),
    ]


def _encode(results: Results) -> Iterator[Outcome]:
    for contest in _of(results, "encode"):
        what = f"encode {contest.title.replace(' at a time', '')}"
        for names, least in (
            (["PyTorch float"], 8.0),
            (["ONNX Runtime float"], 5.0),
            (["ONNX Runtime int8, static", "ONNX Runtime int8, dynamic"], 2.5),
        ):
            yield _against(contest, names, least, what)
        yield _share(results, contest, 0.5, what)


def _search(results: Results) -> Iterator[Outcome]:
    for section, peers in (
        ("search", (("FAISS IndexFlatL2", 50.0),)),
        ("hamming", (("OpenCV BFMatcher", 100.0), ("FAISS IndexBinaryFlat", 40.0))),
    ):
        contest = _at(_of(results, section), GOAL_SIZE)
        if contest is None:
            continue
        what = f"exact search, {short(contest.landmarks)} landmarks"
        for name, least in peers:
            yield _against(contest, [name], least, what, contest.landmarks == GOAL_SIZE)
        if section == "search":
            yield _share(results, contest, 0.4, what, contest.landmarks == GOAL_SIZE)


def _graphs(results: Results) -> Iterator[Outcome]:
    size = 100_000
    contest = _at(_with_recall(results, 0.99), size)
    if contest is not None:
        ours = _named(contest, ["Protomark, exact"])
        for name in ("FAISS HNSW", "hnswlib"):
            what = f"exact search, {short(contest.landmarks)} landmarks; {name} at recall 0.99"
            peer = _named(contest, [name])
            if ours is None or peer is None:
                yield Outcome(what, peer=name, target="≥ 1 ×")
                continue
            ratio = contest.ratio(peer, ours)
            counts = contest.landmarks == size
            yield _ratio_row(what, ours, peer, ratio, 1.0, contest, counts)


def _approximate(results: Results) -> Iterator[Outcome]:
    """Of each run that has the largest size: peers may be spread over several."""
    contests = _with_recall(results, 0.98)
    largest = _at(contests, 10_000_000)
    for contest in contests:
        if largest is not None and contest.landmarks == largest.landmarks:
            yield from _approximate_in(contest, contest.landmarks == 10_000_000)


def _approximate_in(contest: Contest, counts: bool) -> Iterator[Outcome]:
    what = f"recall 0.98, {short(contest.landmarks)} landmarks"
    ours = _named(contest, ["Protomark, approximate"])
    if ours is None:
        yield Outcome(what, target="≥ 20 × the exact scan")
        return
    exact = _named(contest, ["Protomark, exact"])
    if exact is not None:
        ratio = contest.ratio(exact, ours)
        yield _ratio_row(what, ours, exact, ratio, 20.0, contest, counts)
    peers = [timing for timing in contest.timings if not timing.ours and timing.comparable]
    if peers:
        best = min(peers, key=lambda timing: timing.median)
        row = _ratio_row(what, ours, best, contest.ratio(best, ours), 1.0, contest, counts)
        raced = ", ".join(timing.name for timing in peers)
        yield replace(row, peer=f"{row.peer}, the fastest of the peers raced: {raced}")
    if "more" in ours.facts:
        more = ours.facts["more"]
        yield Outcome(
            what,
            f"{more:.2f} bytes a landmark more",
            target="≤ 4 bytes",
            met=_if(counts, more <= 4),
        )


def _frame(results: Results) -> Iterator[Outcome]:
    least = 0.033 if "amx" in results.ceilings else 0.150
    for contest in _of(results, "frame"):
        counts = contest.landmarks == GOAL_SIZE and contest.threads == 2
        for ours in contest.timings:
            yield Outcome(
                f"frame, {short(contest.landmarks)} landmarks, {_threads(contest.threads)}: "
                + ours.name.partition(", ")[2],
                f"{spread([1000 * s for s in ours.seconds])} ms",
                target=f"≤ {1000 * least:.0f} ms" if contest.threads == 2 else "",
                met=_if(counts, ours.median <= least),
            )


def _add(results: Results) -> Iterator[Outcome]:
    for contest in _of(results, "add"):
        yield _against(
            contest,
            ["Protomark, encode alone"],
            0.9,
            f"add to {short(contest.landmarks)} landmarks, {_threads(contest.threads)}",
        )


def _large(results: Results) -> Iterator[Outcome]:
    figures = results.large
    if not figures:
        return
    n = int(figures["landmarks"])
    counts = n == 100_000_000
    for bits in (8, 4):
        label = f"{bits} bits: "
        what = f"sealed, {short(n)} landmarks, {bits} bits"
        if label + "file bytes" not in figures:
            continue
        size = figures[label + "file bytes"]
        opening = figures[label + "open seconds"]
        asking = figures[label + "1,000 queries, seconds"]
        # Runs of before 23 November 2026 know only the second, and call it "recall".
        own = figures.get(label + "recall of this file's nearest", figures.get(label + "recall", 0))
        recall = figures.get(label + "recall of the nearest of 8 bits", own if bits == 8 else None)
        yield Outcome(
            f"{what}: file",
            f"{size / 1e9:.2f} GB",
            target="≤ 3.4 GB",
            met=_if(counts, size <= 3.4e9),
        )
        yield Outcome(
            f"{what}: opening",
            f"{1000 * opening:.1f} ms",
            target="≤ 50 ms",
            met=_if(counts, opening <= 0.05),
        )
        yield Outcome(
            f"{what}: 1,000 queries, 2 threads",
            f"{asking:.3f} s, recall {own:.3f} of this file's nearest"
            + ("" if recall is None else f", {recall:.3f} of the nearest of 8 bits"),
            target="≤ 0.5 s, recall ≥ 0.95",
            met=_if(counts and recall is not None, asking <= 0.5 and (recall or 0) >= 0.95),
        )


def _growth(results: Results) -> Iterator[Outcome]:
    for method in ("exact", "approximate"):
        points = sorted(
            (p["landmarks"], p["seconds"]) for p in results.growth if p["method"] == method
        )
        if len(points) < 2:
            continue
        (n0, s0), (n1, s1) = points[0], points[-1]
        if n0 == n1:
            continue
        exponent = log(s1 / s0) / log(n1 / n0)
        yield Outcome(
            f"{method} search, {short(n0)} to {short(n1)} landmarks",
            f"time ~ landmarks^{exponent:.2f}",
            target="exponent clearly below 1" if method == "approximate" else "",
            met=_if(method == "approximate" and n1 >= GOAL_SIZE, exponent < 0.8),
        )


def _against(
    contest: Contest, names: Sequence[str], least: float, what: str, counts: bool = True
) -> Outcome:
    """Ours against the fastest of these."""
    peer, ours = _named(contest, names), contest.ours
    if peer is None or ours is None:
        return Outcome(what, peer=names[0], target=f"≥ {least:g} ×")
    return _ratio_row(what, ours, peer, contest.ratio(peer), least, contest, counts)


def _ratio_row(
    what: str,
    ours: Timing,
    peer: Timing,
    ratio: Ratio | None,
    least: float,
    contest: Contest,
    counts: bool,
) -> Outcome:
    return Outcome(
        what,
        duration(ours.median),
        f"{peer.name}: {duration(peer.median)}",
        "–" if ratio is None else factor(ratio),
        f"≥ {least:g} ×",
        _if(counts, ratio is not None and ratio.median >= least),
    )


def _share(
    results: Results, contest: Contest, least: float, what: str, counts: bool = True
) -> Outcome:
    """Ours as a part of what vector instructions can do at most."""
    if "amx" in results.ceilings:
        least = 1.0
    share = results.share(contest)
    if share is None:
        return Outcome(what, target=f"≥ {100 * least:.0f} % of the vector ceiling")
    return Outcome(
        what,
        share_text(contest, share),
        target=f"≥ {100 * least:.0f} %",
        met=_if(counts, share >= least),
    )


def _of(results: Results, section: str) -> list[Contest]:
    return [contest for contest in results.contests if contest.section == section]


def _with_recall(results: Results, recall: float) -> list[Contest]:
    return [contest for contest in _of(results, "approximate") if contest.recall == recall]


def _at(contests: Sequence[Contest], landmarks: int) -> Contest | None:
    """The contest of this size, or else the largest."""
    same = [contest for contest in contests if contest.landmarks == landmarks]
    return same[0] if same else max(contests, key=lambda c: c.landmarks, default=None)


def _named(contest: Contest, names: Sequence[str]) -> Timing | None:
    found = [timing for timing in contest.timings if timing.name in names]
    return min(found, key=lambda timing: timing.median, default=None)


def _if(counts: bool, met: bool) -> bool | None:
    return met if counts else None


def _threads(count: int) -> str:
    return f"{count} thread{'s' if count != 1 else ''}"


def spread(values: Sequence[float]) -> str:
    """Median, and least to greatest."""
    ordered = sorted(values)
    middle = ordered[len(ordered) // 2]
    return f"{middle:.1f} ({ordered[0]:.1f} to {ordered[-1]:.1f})"


def share_text(contest: Contest, share: float) -> str:
    """How near the ceiling ours came; where it gets round some of the work, an equivalent."""
    ceiling = "vector" if "multiply_adds" in contest.work else "reading"
    worth = "worth " if contest.section in EQUIVALENT else ""
    return f"{worth}{100 * share:.0f} % of the {ceiling} ceiling"


def factor(ratio: Ratio) -> str:
    """Median, and least to greatest."""
    return f"{ratio.median:.3g} ({ratio.low:.3g} to {ratio.high:.3g})"


def short(count: int) -> str:
    """1,000,000 as 1 M."""
    for scale, unit in ((1_000_000, "M"), (1_000, "k")):
        if count >= scale:
            return f"{count / scale:g} {unit}"
    return str(count)


def duration(seconds: float) -> str:
    """Seconds in the unit that suits them, with three digits."""
    for scale, unit in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns")):
        if seconds >= scale or unit == "ns":
            return f"{seconds / scale:.3g} {unit}"
    raise AssertionError("nanoseconds are the smallest unit")
