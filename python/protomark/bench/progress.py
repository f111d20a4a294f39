"""One bar for the whole bench, in seconds that it takes on a machine like ours."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from protomark.console import progress_console


class Bar:
    """Moves on by sections, and within a section by its steps."""

    def __init__(self, progress: Progress, costs: dict[str, float]) -> None:
        self._progress = progress
        self._costs = costs
        self._task = progress.add_task("", total=sum(costs.values()))
        self._before = 0.0
        self._section = ""
        self._steps = 1
        self._done = 0

    def begin(self, section: str, steps: int) -> None:
        """A section begins that will make so many steps."""
        self._section, self._steps, self._done = section, max(steps, 1), 0
        self._progress.update(self._task, description=section)

    def advance(self, label: str) -> None:
        """A step begins."""
        part = self._costs[self._section] * min(self._done / self._steps, 1)
        self._done += 1
        self._progress.update(
            self._task, completed=self._before + part, description=f"{self._section}: {label}"
        )

    def end(self) -> None:
        """The section is over."""
        self._before += self._costs[self._section]
        self._progress.update(self._task, completed=self._before)


@contextmanager
def bar(costs: dict[str, float]) -> Iterator[Bar]:
    """A bar over sections, section -> seconds it is expected to take, with the time left."""
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=progress_console,
        transient=True,
    ) as progress:
        yield Bar(progress, costs)
