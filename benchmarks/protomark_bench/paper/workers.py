"""Runs trainings that are not cached, in this process or in several."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from typing import Any

import torch

from protomark.cli.terminal import progress_bar
from protomark.progress import tracked
from protomark.training.train import keep_freed_memory
from protomark_bench.cache import ResultCache, key_of
from protomark_bench.paper.scale import Scale, Training
from protomark_bench.paper.trainer import PaperData, TrainingOutcome, train


class Trainings:
    """Runs trainings.

    Args:
        data: data of all trainings.
        scale: length of the trainings.
        cache: cache of results.
        half: whether steps run in bfloat16.
        jobs: trainings at a time, each in a process of its own; 1: in this process.
        threads: threads of one training.

    Attributes:
        made: number of trainings that ran, as they were not cached.
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
        """The key of a result in the cache, from everything that determines it."""
        scale = {k: v for k, v in asdict(self.scale).items() if k not in ("name", "small")}
        return key_of(
            data=self.data.fingerprint,
            objective=training.objective,
            hidden=training.hidden(self.data.bits),
            dim=training.dim,
            seed=training.seed,
            bfloat16=self.half,
            **scale,
        )

    def run(self, trainings: Sequence[Training]) -> dict[Training, TrainingOutcome]:
        """The results of all trainings; the same network under two names is trained once.

        Raises:
            KeyboardInterrupt: finished results are cached.
            OSError: a training process ended by itself.
        """
        keys = {training: self.key(training) for training in trainings}
        found = {key: self._load(key) for key in keys.values()}
        missing = {key: t for t, key in keys.items() if found[key] is None}
        made = (self._here if self.jobs == 1 else self._apart)(missing)
        with progress_bar() as progress:
            for key, outcome in tracked(made, progress, "train", len(missing)):
                values = {name: value for name, value in vars(outcome).items() if name != "weights"}
                self.cache.save_arrays(key, values, outcome.weights)
                found[key] = outcome
                self.made += 1
        results = {training: found[key] for training, key in keys.items()}
        return {training: outcome for training, outcome in results.items() if outcome is not None}

    def _load(self, key: str) -> TrainingOutcome | None:
        found = self.cache.load_arrays(key)
        try:
            return None if found is None else TrainingOutcome(weights=found[1], **found[0])
        except TypeError:
            return None

    def _here(self, missing: dict[str, Training]) -> Iterator[tuple[str, TrainingOutcome]]:
        torch.set_num_threads(self.threads)
        for key, training in missing.items():
            yield key, train(training, self.data, self.scale, self.half)

    def _apart(self, missing: dict[str, Training]) -> Iterator[tuple[str, TrainingOutcome]]:
        # Forking a process that has PyTorch's threads is not safe.
        context = multiprocessing.get_context("spawn")
        arguments = (self.data, self.scale, self.half, self.threads)
        pool = ProcessPoolExecutor(self.jobs, context, _start, arguments)
        try:
            waiting = {pool.submit(_train_one, t): key for key, t in missing.items()}
            for future in as_completed(waiting):
                yield waiting[future], future.result()
        except BrokenProcessPool:
            raise OSError(
                "a training process ended unexpectedly, perhaps for lack of memory: run the same "
                "command with --jobs 1, finished trainings are cached"
            ) from None
        finally:
            pool.shutdown(cancel_futures=True)


_worker: dict[str, Any] = {}


def _start(data: PaperData, scale: Scale, half: bool, threads: int) -> None:
    """Prepare a worker process, which Ctrl-C ends silently."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    keep_freed_memory()
    torch.set_num_threads(threads)
    _worker.update(data=data, scale=scale, half=half)


def _train_one(training: Training) -> TrainingOutcome:
    return train(training, **_worker)
