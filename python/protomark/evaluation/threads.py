"""How many threads there are, and how many the linear algebra of NumPy may use."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager


def one_blas_thread() -> AbstractContextManager[object]:
    """While entered, BLAS computes on the calling thread only."""
    from threadpoolctl import threadpool_limits

    return threadpool_limits(limits=1, user_api="blas")


def available_threads() -> int:
    """Processors that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
