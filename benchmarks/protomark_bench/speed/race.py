"""Contenders that take turns, and their times."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from statistics import median

Advance = Callable[[str], None]

_LONG = 0.1  # seconds of a call beside which it costs little to fill the caches
_REPEATS = 3  # of a shorter one, at least


@dataclass
class Timing:
    """One contender's times in one contest.

    Attributes:
        name: of the contender.
        ours: whether it is Protomark's.
        seconds: per unit, in each round.
        units: how many units one call had; fewer where a contender is slow.
        facts: what else was measured, such as recall, bytes per landmark or building time.
        note: what a reader should know.
        comparable: whether it does the work that the others do, so that a ratio has a meaning.
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
        """Seconds per unit."""
        return median(self.seconds)


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
        work: multiply-adds, and bytes read, per unit of ours, where a ceiling applies to them.
        timings: the contenders, ours first.
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
        """The fastest of Protomark's."""
        own = [timing for timing in self.timings if timing.ours]
        return min(own, key=lambda timing: timing.median, default=None)

    def ratio(self, peer: Timing) -> tuple[float, float, float] | None:
        """How many times as fast as the peer ours is: median, least and greatest of the rounds.

        None for ours itself and where the work differs.
        """
        ours = self.ours
        if ours is None or peer is ours or not peer.comparable:
            return None
        ratios = [b / a for a, b in zip(ours.seconds, peer.seconds, strict=True)]
        return median(ratios), min(ratios), max(ratios)


@dataclass
class Contender:
    """Who takes part in a race.

    Attributes:
        name, ours, facts, note, comparable: see `Timing`.
        run: does the work for the number of units it is given, from the start of the data.
        least: fewest units that are worth timing.
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
    """How much time a race may take.

    Attributes:
        rounds: how often each contender runs.
        shortest: seconds that a turn takes at least; quick work is done several times in it.
        longest: seconds that a turn takes at most, by doing fewer units, about.
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
    """Times contenders in turns: each runs once in every round, so that all meet the same machine.

    A turn of less than a tenth of a second begins with a call that is not timed, and has three at
    least that are: the contender before may have left the caches full of other things.

    Args:
        contenders: who takes part.
        units: how many units the work has; a contender that is too slow does fewer in a turn.
        pace: rounds and time.
        advance: called with a contender's name before each of its turns, and its warm-up.
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
    """Units of a call and calls in a turn, found by a warm-up."""
    least = min(contender.least, units)
    _turn(contender, least, 1)
    each = _turn(contender, least, 1) / least
    count = min(units, max(least, int(pace.longest / each))) if each > 0 else units
    seconds = max(each * count, 1e-9)
    if seconds >= _LONG:
        return count, 1
    return count, min(max(round(pace.shortest / seconds), _REPEATS), 1000)


def _turn(contender: Contender, count: int, repeats: int) -> float:
    """Seconds of one call: median of `repeats`."""
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        contender.run(count)
        seconds.append(time.perf_counter() - begin)
    return median(seconds)
