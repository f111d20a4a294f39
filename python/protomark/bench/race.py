"""Contenders taking turns."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from statistics import median

from protomark.bench.results import Timing

Advance = Callable[[str], None]

_LONG = 0.1  # seconds of a call beside which it costs little to fill the caches
_REPEATS = 3  # of a shorter one, at least


@dataclass
class Contender:
    """Who takes part in a race.

    Attributes:
        name: who.
        run: does the work for the number of units it is given, from the start of the data.
        ours: whether it is Protomark's.
        least: fewest units that are worth timing.
        comparable, facts, note: as in `Timing`.
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
    """Time contenders in turns: each runs once in every round, so that all meet the same machine.

    A turn of less than a tenth of a second begins with a call that is not timed, and has three at
    least that are: the one before may have left the caches full of other things.

    Args:
        contenders: who takes part.
        units: how many units the work has; a contender that is too slow does fewer in a turn.
        pace: rounds and time.
        advance: called with a contender's name before each of its turns (and its warm-up).
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
        Timing(
            contender.name,
            contender.ours,
            times,
            count,
            dict(contender.facts),
            contender.note,
            contender.comparable,
        )
        for contender, (count, _), times in zip(contenders, plans, seconds, strict=True)
    ]


def turns(contenders: int, pace: Pace) -> int:
    """How often `race` calls `advance` for so many contenders."""
    return contenders * (pace.rounds + 1)


def _plan(contender: Contender, units: int, pace: Pace) -> tuple[int, int]:
    """Units of a call, and calls in a turn, found by a warm-up."""
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
        began = time.perf_counter()
        contender.run(count)
        seconds.append(time.perf_counter() - began)
    return median(seconds)
