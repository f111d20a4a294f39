"""CPU threads: how many there are, work shared among them, and how many BLAS may use."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import TypeVar

from protomark.progress import Progress, silent

S = TypeVar("S")
T = TypeVar("T")


def available_threads() -> int:
    """Processors that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def parallel_map(
    function: Callable[[S], T],
    items: Sequence[S],
    threads: int,
    progress: Progress = silent,
    stage: str = "",
) -> list[T]:
    """`[function(item) for item in items]` on several threads.

    Worth it where the function spends its time without the GIL, as OpenCV and the core do. An
    exception cancels what has not begun.

    Args:
        function: called once per item.
        items: its arguments.
        threads: threads to call it on.
        progress: told of each result.
        stage: name of the stage, for `progress`.
    """
    results = []
    progress(stage, 0, len(items))
    if threads <= 1:
        for item in items:
            results.append(function(item))
            progress(stage, len(results), len(items))
        return results
    with ThreadPoolExecutor(threads) as pool:
        futures = [pool.submit(function, item) for item in items]
        try:
            for future in futures:
                results.append(future.result())
                progress(stage, len(results), len(items))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return results


def one_blas_thread() -> AbstractContextManager[object]:
    """A context in which BLAS computes on the calling thread only."""
    from threadpoolctl import threadpool_limits

    return threadpool_limits(limits=1, user_api="blas")
