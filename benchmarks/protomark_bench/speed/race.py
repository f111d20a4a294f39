"""Times contenders that take turns."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from statistics import median

Advance = Callable[[str], None]

_LONG = 0.1  # seconds of a call that needs no warm caches
_REPEATS = 3  # smallest number of repetitions of a shorter call


@dataclass
class Timing:
    """The times of a contender in a contest.

    Attributes:
        name: name of the contender.
        ours: whether it is Protomark's.
        seconds: seconds per unit in each round.
        units: number of units per call, fewer if the contender is slow.
        facts: further measurements, such as recall, bytes per landmark or building time.
        note: further text for the reader.
        comparable: whether it does the same work as the others, so that a ratio is meaningful.
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
        """Median seconds per unit."""
        return median(self.seconds)


@dataclass
class Contest:
    """Contenders that do the same work in the same rounds.

    Attributes:
        section: encode, search, hamming, approximate, real, frame or add.
        title: description of the work.
        unit: unit of the work: a descriptor, a query, a frame.
        threads: threads of every contender.
        landmarks: landmarks of the map, 0 without a map.
        recall: recall@1 that every contender reaches, None if all are exact.
        work: our multiply-adds and bytes read per unit, if a ceiling applies to them.
        timings: times of the contenders, ours first.
    """

    section: str
    title: str
    unit: str
    threads: int
    landmarks: int = 0
    recall: float | None = None
    work: dict[str, float] = field(default_factory=dict)
    timings: list[Timing] = field(default_factory=list)

    @property
    def ours(self) -> Timing | None:
        """The fastest of Protomark's contenders."""
        ours = [timing for timing in self.timings if timing.ours]
        return min(ours, key=lambda timing: timing.median, default=None)

    def ratio(self, peer: Timing) -> tuple[float, float, float] | None:
        """The peer's time over ours: median, least and greatest of the rounds.

        None for ours itself, and for a peer that does other work.
        """
        ours = self.ours
        if ours is None or peer is ours or not peer.comparable:
            return None
        ratios = [b / a for a, b in zip(ours.seconds, peer.seconds, strict=True)]
        return median(ratios), min(ratios), max(ratios)


@dataclass
class Contender:
    """A participant of a race.

    Attributes:
        name, ours, facts, note, comparable: see `Timing`.
        run: does the work for the first n units of the data.
        least: smallest number of units to time.
    """

    name: str
    run: Callable[[int], object]
    ours: bool = False
    least: int = 1
    comparable: bool = True
    facts: dict[str, float] = field(default_factory=dict)
    note: str = ""


@dataclass(frozen=True)
class Pace:
    """The time that a race takes.

    Attributes:
        rounds: number of turns per contender.
        shortest: smallest duration of a turn in seconds, in which fast work is repeated.
        longest: approximate limit on the duration of a turn, in which slow work has fewer units.
    """

    rounds: int = 7
    shortest: float = 0.05
    longest: float = 2.0


def race(
    contenders: Sequence[Contender],
    units: int,
    pace: Pace,
    advance: Advance = lambda _: None,
) -> list[Timing]:
    """Time contenders in turns: each runs once per round, so that all find the same machine.

    A turn of less than a tenth of a second starts with a call that is not timed, as the previous
    contender has filled the caches, and has at least three timed calls.

    Args:
        contenders: the participants.
        units: number of units of the work; slow contenders do fewer per turn.
        pace: rounds and time.
        advance: called with a contender's name before its warm-up and each of its turns.
    """
    plans = []
    for contender in contenders:
        advance(contender.name)
        plans.append(_plan(contender, units, pace))
    seconds: list[list[float]] = [[] for _ in contenders]
    for _ in range(pace.rounds):
        for contender, (count, repeats), times in zip(contenders, plans, seconds, strict=True):
            advance(contender.name)
            if repeats > 1:
                contender.run(count)
            times.append(_turn(contender, count, repeats) / count)
    return [
        Timing(c.name, c.ours, times, count, dict(c.facts), c.note, c.comparable)
        for c, (count, _), times in zip(contenders, plans, seconds, strict=True)
    ]


def _plan(contender: Contender, units: int, pace: Pace) -> tuple[int, int]:
    """Units per call and calls per turn, by a warm-up."""
    least = min(contender.least, units)
    _turn(contender, least, 1)
    each = _turn(contender, least, 1) / least
    count = min(units, max(least, int(pace.longest / each))) if each > 0 else units
    seconds = max(each * count, 1e-9)
    if seconds >= _LONG:
        return count, 1
    return count, min(max(round(pace.shortest / seconds), _REPEATS), 1000)


def _turn(contender: Contender, count: int, repeats: int) -> float:
    """Median seconds of `repeats` calls."""
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        contender.run(count)
        seconds.append(time.perf_counter() - begin)
    return median(seconds)
