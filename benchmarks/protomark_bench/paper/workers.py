"""Many trainings, in this process or in several, behind one progress bar."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

import torch
from rich.progress import (
    BarColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from protomark.console import progress_console
from protomark.training.train import keep_freed_memory
from protomark_bench.cache import ResultCache, key_of
from protomark_bench.paper.scale import Scale, Training
from protomark_bench.paper.trainer import PaperData, TrainingOutcome, train

# A step costs something besides the network: drawing, unpacking, the loss.
_STEP_OVERHEAD = 150_000


class Stopped(Exception):  # noqa: N818 - no error, as KeyboardInterrupt is none
    """A training was told to stop."""


class Trainings:
    """Runs trainings, each one only if its result is not in the cache.

    Args:
        data: what they read.
        scale: how long they go on.
        cache: of results.
        half: whether steps run in bfloat16.
        jobs: trainings at a time, each in a process of its own; 1 trains in this one.
        threads: threads of one training.

    Attributes:
        made: how many trainings were run here rather than found.
    """

    def __init__(
        self, data: PaperData, scale: Scale, cache: ResultCache, half: bool, jobs: int, threads: int
    ) -> None:
        self.data = data
        self.scale = scale
        self.cache = cache
        self.half = half
        self.jobs = jobs
        self.threads = threads
        self.made = 0

    def key(self, training: Training) -> str:
        """The key of the result in the cache: everything that decides it."""
        scale = {k: v for k, v in asdict(self.scale).items() if k not in ("name", "quick")}
        return key_of(
            data=self.data.fingerprint,
            objective=training.objective,
            hidden=training.hidden(self.data.bits),
            dim=training.dim,
            seed=training.seed,
            bfloat16=self.half,
            **scale,
        )

    def run(self, trainings: Sequence[Training], later: int = 0) -> dict[Training, TrainingOutcome]:
        """The results of all, in the order given.

        Args:
            trainings: may hold the same network under two names; it is trained once.
            later: about how many more will be asked for after these, for the time left.

        Raises:
            KeyboardInterrupt: what is finished is in the cache.
        """
        keys = {training: self.key(training) for training in trainings}
        found = {key: self._load(key) for key in keys.values()}
        todo = {key: t for t, key in keys.items() if found[key] is None}
        if todo:
            with _bar() as bar:
                for key, outcome in self._train(todo, bar, later):
                    self._save(key, outcome)
                    found[key] = outcome
                    self.made += 1
        results = {training: found[key] for training, key in keys.items()}
        return {training: outcome for training, outcome in results.items() if outcome is not None}

    def _save(self, key: str, outcome: TrainingOutcome) -> None:
        values = {name: value for name, value in vars(outcome).items() if name != "weights"}
        self.cache.save_arrays(key, values, outcome.weights)

    def _load(self, key: str) -> TrainingOutcome | None:
        found = self.cache.load_arrays(key)
        if found is None:
            return None
        values, weights = found
        values["history"] = [tuple(entry) for entry in values["history"]]
        try:
            return TrainingOutcome(weights=weights, **values)
        except TypeError:
            return None

    def _train(
        self, todo: dict[str, Training], bar: Progress, later: int
    ) -> Iterator[tuple[str, TrainingOutcome]]:
        """Keys and results, as they are finished."""
        costs = [_STEP_OVERHEAD + t.multiply_adds(self.data.bits) for t in todo.values()]
        task = bar.add_task("", total=sum(costs) * (1 + later / len(costs)))
        finished = 0

        def show(shares: Sequence[float]) -> None:
            done = sum(cost * share for cost, share in zip(costs, shares, strict=True))
            text = f"trainings: {finished} of {len(costs) + later} done"
            bar.update(task, completed=done, description=text)

        for key, outcome in (self._here if self.jobs == 1 else self._apart)(todo, show):
            finished += 1
            yield key, outcome

    def _here(self, todo: dict[str, Training], show: Any) -> Iterator[tuple[str, TrainingOutcome]]:
        torch.set_num_threads(self.threads)
        shares = [0.0] * len(todo)
        for i, (key, training) in enumerate(todo.items()):

            def report(step: int, i: int = i) -> None:
                shares[i] = _share(step, self.scale)
                show(shares)

            outcome = train(training, self.data, self.scale, self.half, report)
            shares[i] = 1.0
            yield key, outcome

    def _apart(self, todo: dict[str, Training], show: Any) -> Iterator[tuple[str, TrainingOutcome]]:
        # Forking a process that has PyTorch's threads is not safe.
        context = multiprocessing.get_context("spawn")
        shares = context.Array("d", len(todo))
        stop = context.Event()
        pool = ProcessPoolExecutor(
            min(self.jobs, len(todo)),
            context,
            _start,
            (self.data, self.scale, self.half, self.threads, shares, stop),
        )
        try:
            waiting: dict[Future[TrainingOutcome], str] = {
                pool.submit(_train_one, i, training): key
                for i, (key, training) in enumerate(todo.items())
            }
            while waiting:
                done, _ = wait(waiting, timeout=0.5, return_when=FIRST_COMPLETED)
                for future in done:
                    yield waiting.pop(future), future.result()
                show(shares[:])
        except BrokenProcessPool:
            raise OSError(
                "a training process ended of itself, perhaps for lack of memory; what is finished "
                "is cached: run the same command with --jobs 1"
            ) from None
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


_worker: dict[str, Any] = {}


def _start(data: PaperData, scale: Scale, half: bool, threads: int, shares: Any, stop: Any) -> None:
    """Prepare a worker process; Ctrl-C is for the process that waits for it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    keep_freed_memory()
    torch.set_num_threads(threads)
    _worker.update(data=data, scale=scale, half=half, shares=shares, stop=stop)


def _train_one(index: int, training: Training) -> TrainingOutcome:
    def report(step: int) -> None:
        if _worker["stop"].is_set():
            raise Stopped
        _worker["shares"][index] = _share(step, _worker["scale"])

    outcome = train(training, _worker["data"], _worker["scale"], _worker["half"], report)
    _worker["shares"][index] = 1.0
    return outcome


def _share(step: int, scale: Scale) -> float:
    return min(step / scale.expected_steps, 0.99)


@contextmanager
def _bar() -> Iterator[Progress]:
    """A bar in percent: its unit is a multiply-add, which nobody wants to read."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    # Trainings differ in speed, so the time left follows from more than the last half minute.
    with Progress(
        *columns, console=progress_console, transient=True, speed_estimate_period=300
    ) as bar:
        yield bar
