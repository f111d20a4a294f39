"""The fastest setting of an approximate index that finds enough."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

S = TypeVar("S")


@dataclass(frozen=True)
class Trial(Generic[S]):
    """What a setting comes to.

    Attributes:
        setting: tried.
        recall: share of queries whose nearest it finds.
        seconds: of a query.
        queries: that recall was measured on.
    """

    setting: S
    recall: float
    seconds: float
    queries: int


def tune(
    lines: Iterable[Sequence[S]],
    measure: Callable[[S], tuple[float, float, int]],
    goals: Sequence[float],
) -> dict[float, Trial[S] | None]:
    """The fastest setting for each least recall, None where none reaches it.

    Args:
        lines: settings, in lines along which recall and time grow; a line is left as soon as it
            reaches the highest goal, or takes ten times what already reaches it.
        measure: gives recall, seconds and queries of a setting.
        goals: least recalls.
    """
    trials: list[Trial[S]] = []
    highest = max(goals)
    for line in lines:
        for setting in line:
            trial = Trial(setting, *measure(setting))
            trials.append(trial)
            done = [t.seconds for t in trials if t.recall >= highest]
            if trial.recall >= highest or (done and trial.seconds > 10 * min(done)):
                break
    return {goal: _fastest([t for t in trials if t.recall >= goal]) for goal in goals}


def _fastest(trials: Sequence[Trial[S]]) -> Trial[S] | None:
    return min(trials, key=lambda trial: trial.seconds, default=None)
