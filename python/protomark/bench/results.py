"""What a bench has measured, and its JSON."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from protomark.files import write_text

FORMAT, VERSION = "protomark-bench", 1
NOT_ASKED_FOR = "not asked for"  # why something was left out that another run may have


@dataclass
class Timing:
    """One contender's times in one contest.

    Attributes:
        name: who.
        ours: whether it is Protomark's.
        seconds: of one unit, in each round.
        units: how many units one call had; fewer where a contender is slow.
        facts: what else was measured, such as recall, bytes a landmark or building time.
        note: what a reader should know.
        comparable: whether its work is that of the others, so that a ratio means something.
    """

    name: str
    ours: bool
    seconds: list[float]
    units: int
    facts: dict[str, float] = field(default_factory=dict)
    note: str = ""
    comparable: bool = True

    @property
    def median(self) -> float:
        """Seconds of one unit."""
        return median(self.seconds)


@dataclass(frozen=True)
class Ratio:
    """How many times as fast: median, least and greatest of the rounds."""

    median: float
    low: float
    high: float


@dataclass
class Contest:
    """Contenders that did the same work in the same rounds.

    Attributes:
        section: encode, search, hamming, approximate, real, frame or add.
        title: what was done.
        unit: what `seconds` are for: a descriptor, a query, a frame.
        threads: of every contender.
        landmarks: in the map, 0 where there is none.
        recall: least recall@1 of every contender, None where all are exact.
        work: multiply-adds, and bytes read, of one unit of ours, where a ceiling applies to them.
        timings: the contenders, ours first.
        share: our part of the ceiling, of the machine as it was in that run; see `Results.share`.
    """

    section: str
    title: str
    unit: str
    threads: int
    landmarks: int = 0
    recall: float | None = None
    work: dict[str, float] = field(default_factory=dict)
    timings: list[Timing] = field(default_factory=list)
    share: float | None = None

    @property
    def key(self) -> tuple[object, ...]:
        """What was measured, and who took part: a run that had others is another contest."""
        names = tuple(timing.name for timing in self.timings)
        return (self.section, self.title, self.threads, self.recall, names)

    @property
    def ours(self) -> Timing | None:
        """The fastest of ours."""
        own = [timing for timing in self.timings if timing.ours]
        return min(own, key=lambda timing: timing.median, default=None)

    def ratio(self, peer: Timing, to: Timing | None = None) -> Ratio | None:
        """Times as fast as the peer that ours is (or `to`), round by round; None without sense."""
        ours = to or self.ours
        if ours is None or peer is ours or not peer.comparable:
            return None
        ratios = [b / a for a, b in zip(ours.seconds, peer.seconds, strict=True)]
        return Ratio(median(ratios), min(ratios), max(ratios))


@dataclass
class Results:
    """All of one run.

    Attributes:
        machine: CPU, instruction set, versions and so on, name -> text.
        data: what was measured on, name -> text.
        ceilings: multiply-adds a second by instruction set, and "read", bytes a second; one thread.
        contests: in the order they were run.
        resemblance: recall of FAISS on real and on grown data, index -> [real, grown].
        growth: points {landmarks, method, seconds (a query), bytes (a landmark), ...}.
        large: figures of the largest map, name -> value; empty where it was not made.
        skipped: what was left out, and why.
        interrupted: whether the run ended early.
        command: the command line that does the same again.
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

    def extend(self, later: Results) -> None:
        """Take what another run on this machine measured.

        Raises:
            ValueError: it was another machine, or data of another kind.
        """
        for name in ("CPU", "instruction set in use"):
            if self.machine.get(name) != later.machine.get(name):
                raise ValueError(f"runs of two machines: {name} {later.machine.get(name)}")
        if self.data != later.data:
            raise ValueError(f"runs on different data: {later.data}")
        known = {contest.key for contest in self.contests}
        self.contests += [contest for contest in later.contests if contest.key not in known]
        curve = {(p["landmarks"], p["method"]): p for p in later.growth + self.growth}
        self.growth = sorted(curve.values(), key=lambda p: (p["landmarks"], p["method"] != "exact"))
        self.large |= later.large
        self.skipped += [note for note in later.skipped if note not in self.skipped]
        raced = {
            f"{timing.name}, {contest.title.partition(', ')[2]}: {NOT_ASKED_FOR}"
            for contest in self.contests
            for timing in contest.timings
        }
        self.skipped = [note for note in self.skipped if not note.startswith(tuple(raced))]
        self.interrupted |= later.interrupted
        self.command += f"\n    {later.command}"

    @property
    def vector_ceiling(self) -> float | None:
        """Multiply-adds a second of one thread's best vector instructions; tiles left out."""
        rates = [rate for name, rate in self.ceilings.items() if name not in ("read", "amx")]
        return max(rates, default=None)

    def share(self, contest: Contest) -> float | None:
        """Our part of the ceiling that applies to the contest's work, None where none does.

        Of multiply-adds: of the vector ceiling of all threads. Of bytes: of what one thread reads.
        """
        ours = contest.ours
        if contest.share is not None or ours is None:
            return contest.share
        if "multiply_adds" in contest.work and self.vector_ceiling is not None:
            rate = contest.work["multiply_adds"] / ours.median
            return rate / (self.vector_ceiling * contest.threads)
        if "bytes" in contest.work and "read" in self.ceilings and contest.threads == 1:
            return contest.work["bytes"] / ours.median / self.ceilings["read"]
        return None

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the JSON, whole or not at all."""
        for contest in self.contests:
            contest.share = self.share(contest)
        document = {"format": FORMAT, "version": VERSION, **asdict(self)}
        write_text(path, json.dumps(document, indent=1) + "\n")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Results:
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is not such a file.
        """
        try:
            document = json.loads(Path(path).read_text(encoding="utf-8"))
            if not isinstance(document, dict) or document.pop("format", None) != FORMAT:
                raise ValueError(f"{path}: not results of `protomark bench --json`")
            document.pop("version")
            contests = [
                Contest(**{**entry, "timings": [Timing(**t) for t in entry["timings"]]})
                for entry in document.pop("contests")
            ]
            return cls(contests=contests, **document)
        except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: broken results file ({error!r})") from None
