"""CPU threads: their number, work shared among them, and BLAS on one of them."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from itertools import islice
from typing import TypeVar

from protomark.progress import Progress, silent, tracked

S = TypeVar("S")
T = TypeVar("T")


def available_threads() -> int:
    """Number of processors that this process may run on."""
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

    Several threads help functions that run without the GIL, as OpenCV and the core do. An exception
    cancels the calls that have not begun. Each result is a step of `stage` for `progress`.
    """
    if threads <= 1:
        return [function(item) for item in tracked(items, progress, stage)]
    with ThreadPoolExecutor(threads) as pool:
        futures = [pool.submit(function, item) for item in items]
        try:
            return [future.result() for future in tracked(futures, progress, stage)]
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def map_ahead(
    function: Callable[[S], T], items: Iterable[S], threads: int
) -> Generator[T, None, None]:
    """Yield `function(item)` for each item in order, from several threads.

    Of the items only those at hand are held. Closing the generator cancels what has not begun.
    """
    with ThreadPoolExecutor(threads) as pool:
        pending: deque[Future[T]] = deque()
        try:
            for item in items:
                pending.append(pool.submit(function, item))
                if len(pending) >= 2 * threads:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def read_ahead(items: Iterator[S], threads: int) -> Iterator[S]:
    """The items; with several threads, one of them makes the next while the caller uses this."""
    if threads <= 1:
        yield from items
        return
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(list, islice(items, 1))
        while item := future.result():
            future = pool.submit(list, islice(items, 1))
            yield item[0]


def one_blas_thread() -> AbstractContextManager[object]:
    """A context in which BLAS computes on the calling thread only."""
    from threadpoolctl import threadpool_limits

    return threadpool_limits(limits=1, user_api="blas")
