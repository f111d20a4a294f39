"""A map in shards that replicas of Ray Serve search, wherever in a cluster they run."""

from __future__ import annotations

import asyncio
import logging
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.distributed.cluster import connected
from protomark.extras import optional
from protomark.maps.neighbours import Found, merged
from protomark.maps.sharded_map import Ids, ShardedMap

# A replica that dies is replaced within seconds; until then another one is asked.
_RETRY_SECONDS, _PAUSE = 20.0, 0.1


class Holder:
    """Replicas that map some shards from disk and search them.

    Args:
        path: the folder of shards, or the map.
        others: further holders, which Ray Serve starts with this one.
    """

    def __init__(self, path: str, *others: Any) -> None:
        self._map = ShardedMap(path)

    async def search(
        self, chosen: list[tuple[str, Ids | None]], codes: NDArray[np.int8], *how: Any
    ) -> Found:
        """See `ShardedMap.search_shards`."""
        return await asyncio.to_thread(self._map.search_shards, chosen, codes, *how)

    def process(self) -> int:
        """The id of this replica's process."""
        return os.getpid()


class ReplicatedMap(ShardedMap):
    """A `ShardedMap` whose searches run in replicas; answers are the same, bit for bit.

    Everything else, such as positions, is read here, by memory mapping.

    Args:
        path: the folder, which the cluster's nodes see under the same path.
        handles: Ray Serve's handles of the holders, which share the shards.
    """

    def __init__(self, path: str | os.PathLike[str], handles: list[Any]) -> None:
        super().__init__(Path(path).resolve())
        self._handles = handles

    def _searches(
        self,
        chosen: Iterable[tuple[Any, Ids | None]],
        codes: NDArray[np.int8],
        k: int,
        max_distance: int | None,
        threads: int,
        recall: float | None,
    ) -> list[Found]:
        shares: list[list[tuple[str, Ids | None]]] = [[] for _ in self._handles]
        places = {shard: i * len(shares) // len(self.shards) for i, shard in enumerate(self.shards)}
        for part, some in chosen:
            # A shard that has just come or gone may be anybody's.
            shares[places.get(part.shard, 0)].append((part.shard.answering.identity, some))
        asks = [
            partial(handle.search.remote, share, codes, k, max_distance, recall)
            for handle, share in zip(self._handles, shares, strict=True)
            if share
        ]
        calls = [ask() for ask in asks]
        answers = [_answer(call, ask) for call, ask in zip(calls, asks, strict=True)]
        return [merged(answers, k)] if answers else []


def _answer(call: Any, again: Callable[[], Any]) -> Found:
    """The result of a call; it is made again if a replica dies.

    Raises:
        ConnectionError: no replica answers.
    """
    ray = optional("ray")
    give_up = time.monotonic() + _RETRY_SECONDS
    while True:
        try:
            return call.result(timeout_s=max(0.1, give_up - time.monotonic()))
        except ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, (OSError, ValueError, KeyError)):
                raise error.cause from None
            raise
        except (ray.exceptions.RayError, TimeoutError) as error:
            if time.monotonic() > give_up:
                raise ConnectionError(
                    f"no replica of the map's shards answers ({type(error).__name__})"
                ) from None
        time.sleep(_PAUSE)
        call = again()


@contextmanager
def replicated(path: Path, address: str, replicas: int) -> Iterator[ReplicatedMap]:
    """Yield a map whose shards are held by Ray Serve until the end of the block.

    Args:
        path: the folder of shards, or a map.
        address: see `protomark.distributed.cluster.connected`.
        replicas: how many processes hold each shard.

    Raises:
        ConnectionError, ValueError: see `connected`.
        FileNotFoundError, FileError, ValueError: see `ShardedMap`.
    """
    shards = len(ShardedMap(path).shards)
    serve = optional("ray.serve")
    with connected(address, 0) as ray:
        cpus = ray.cluster_resources().get("CPU", 1)
        holders = int(np.clip(cpus // replicas, 1, shards))
        options = {
            "num_replicas": replicas,
            "ray_actor_options": {"num_cpus": min(1.0, cpus / (holders * replicas))},
            "logging_config": {"enable_access_log": False, "log_level": "ERROR"},
            "health_check_period_s": 2,
            "max_ongoing_requests": 16,
        }
        logging.getLogger("ray.serve").setLevel(logging.ERROR)
        serve.start(proxy_location="Disabled")
        where = str(path.resolve())
        app = f"protomark-{os.getpid()}-{time.time_ns()}"
        names = [f"shards-{i}" for i in range(holders)]
        bound: list[Any] = []
        for name in reversed(names):
            others = bound if name == names[0] else []
            bound.append(serve.deployment(Holder, name=name, **options).bind(where, *others))
        serve.run(bound[-1], name=app, route_prefix=None)
        try:
            yield ReplicatedMap(path, [serve.get_deployment_handle(n, app) for n in names])
        finally:
            serve.delete(app)
