"""The peers of Protomark; each library is imported only if it is installed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec

# Distributions by module.
DISTRIBUTIONS = {
    "torch": "torch",
    "onnxruntime": "onnxruntime",
    "onnx": "onnx",
    "faiss": "faiss-cpu",
    "cv2": "opencv-contrib-python-headless",
    "hnswlib": "hnswlib",
    "usearch": "usearch",
}


def installed(*modules: str) -> bool:
    """Whether all these modules are installed."""
    return all(find_spec(module) is not None for module in modules)


def missing() -> list[str]:
    """A sentence per peer that is not installed, with the command that installs it."""
    return [
        f"{distribution} is not installed (pip install {distribution})"
        for module, distribution in DISTRIBUTIONS.items()
        if not installed(module)
    ]


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Set the number of threads of every peer with a global setting, inside the context.

    ONNX Runtime, hnswlib and USearch take theirs per session or call.
    """
    from threadpoolctl import threadpool_limits

    with ExitStack() as stack:
        if installed("torch"):
            import torch

            stack.callback(torch.set_num_threads, torch.get_num_threads())
            torch.set_num_threads(count)
        if installed("cv2"):
            import cv2

            stack.callback(cv2.setNumThreads, cv2.getNumThreads())
            cv2.setNumThreads(count)
        if installed("faiss"):
            import faiss

            stack.callback(faiss.omp_set_num_threads, faiss.omp_get_max_threads())
            faiss.omp_set_num_threads(count)
        stack.enter_context(threadpool_limits(count))
        yield
