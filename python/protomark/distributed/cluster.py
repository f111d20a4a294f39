"""Connects to a Ray cluster, and waits for its tasks."""

from __future__ import annotations

import logging
import os
import re
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from protomark.extras import optional

LOCAL = "local"
# Seconds in which an address has to answer.
_TIMEOUT = 5.0
# What a client of gRPC, which Ray speaks, sends first, and the type of the frame that it gets
# (RFC 9113, 3.4 and 6.5).
_SETTINGS = b"\4"
_GREETING = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + b"\0\0\0" + _SETTINGS + bytes(5)
# Tries of a task whose worker or node dies; an error of ours ends the build at once.
TRIES = 50


@contextmanager
def connected(address: str, memory: int) -> Iterator[Any]:
    """Yield Ray, connected to a cluster; one that this process is connected to already stays so.

    Args:
        address: "local" for a cluster on this machine that ends with the block, "auto" for the one
            that runs on it, or HOST:PORT.
        memory: bytes of a worker, which the object store of a local cluster gets, too.

    Raises:
        ConnectionError: no cluster answers there.
        ValueError: that is no address, or no node has so much memory.
    """
    ray = optional("ray")
    quiet = {"log_to_driver": False, "logging_level": logging.ERROR}
    if ray.is_initialized():
        _check_nodes(ray, memory)
        yield ray
        return
    try:
        if address == LOCAL:
            ray.init(
                address=LOCAL,
                include_dashboard=False,
                object_store_memory=max(memory, 200_000_000),
                **quiet,
            )
        else:
            _check_answers(address)
            ray.init(address=address, **quiet)
    except (ConnectionError, TimeoutError, RuntimeError) as error:
        told = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConnectionError(
            f"no Ray cluster answers at {address} ({told}): start one with `ray start --head`, or "
            "name another, or local"
        ) from None
    try:
        _check_nodes(ray, memory)
        yield ray
    finally:
        ray.shutdown()


def _check_answers(address: str) -> None:
    """Raise at once where Ray would try for minutes."""
    if address == "auto":
        return
    found = re.fullmatch(r"(?:ray://)?\[?([\w.:-]+?)\]?:(\d{1,5})", address)
    if not found:
        raise ValueError(f"--ray {address} is no address: give local, auto or HOST:PORT")
    try:
        with socket.create_connection((found[1], int(found[2])), _TIMEOUT) as connection:
            if os.environ.get("RAY_USE_TLS", "0") == "1":
                return
            connection.sendall(_GREETING)
            answer = connection.recv(9)
    except (OSError, OverflowError) as error:
        raise ConnectionError(str(error)) from None
    if answer[3:4] != _SETTINGS:
        raise ConnectionError("something else listens there")


def _check_nodes(ray: Any, memory: int) -> None:
    most = max(
        (node["Resources"].get("memory", 0) for node in ray.nodes() if node["Alive"]), default=0
    )
    if most < memory:
        raise ValueError(
            f"--memory {memory / 1e6:,.0f} is more than a node of the cluster has to give "
            f"({most / 1e6:,.0f} MB): give less"
        )


class Tasks:
    """Tasks that run, each with what to do with its first result."""

    def __init__(self, ray: Any, memory: int) -> None:
        self._ray, self._memory = ray, memory
        self._pending: dict[Any, Callable[[Any], None]] = {}

    def __len__(self) -> int:
        return len(self._pending)

    def start(
        self,
        then: Callable[[Any], None],
        function: Callable[..., Any],
        *args: Any,
        results: int = 1,
    ) -> list[Any]:
        """Start a task; returns references to its results but the first, which `then` gets."""
        task = self._ray.remote(function).options(
            num_cpus=1, memory=self._memory, max_retries=TRIES, num_returns=results
        )
        found = task.remote(*args)
        first, *others = found if results > 1 else [found]
        self._pending[first] = then
        return others

    def wait(self) -> None:
        """Wait for a task or more, and do what is to be done with them."""
        ray = self._ray
        ready, _ = ray.wait(list(self._pending), num_returns=1, timeout=None)
        for ref in ready:
            then = self._pending.pop(ref)
            try:
                result = ray.get(ref)
            except ray.exceptions.RayTaskError as error:
                cause = error.cause
                if isinstance(cause, ray.exceptions.RayError):
                    raise _lost(cause) from None
                if isinstance(cause, (OSError, ValueError, KeyError, ModuleNotFoundError)):
                    raise cause from None
                raise
            except ray.exceptions.RayError as error:
                raise _lost(error) from None
            then(result)

    def cancel(self) -> None:
        """End all tasks."""
        for ref in self._pending:
            self._ray.cancel(ref, force=True)


def _lost(error: Exception) -> OSError:
    return OSError(
        f"workers of the cluster failed too often or cannot be reached ({type(error).__name__}): "
        "look into Ray's logs, then go on with --resume"
    )
