"""The command `protomark serve`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from protomark.cli.options import MaxQueryKeypoints, MaxSize, Recall, Threads

if TYPE_CHECKING:
    from protomark.maps.sharded_map import ShardedMap


def serve(
    scene: Annotated[
        Path,
        typer.Argument(
            metavar="MAP",
            help="Map file (.pmk) with positions, a folder of `protomark map`, or one of shards.",
        ),
    ],
    host: Annotated[
        str, typer.Option(help="Address to listen at; 0.0.0.0 for all of this machine.")
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port; 0 for any that is free.")
    ] = 8000,
    max_keypoints: MaxQueryKeypoints = None,
    max_size: MaxSize = 1600,
    recall: Recall = None,
    threads: Threads = 0,
    max_megabytes: Annotated[
        float, typer.Option(min=0.001, help="Largest body of a request, 10^6 bytes.")
    ] = 20.0,
    max_megapixels: Annotated[
        float, typer.Option(min=0.01, help="Largest image, 10^6 pixels.")
    ] = 50.0,
    timeout: Annotated[
        float, typer.Option(min=0.1, help="Seconds until a request is answered or given up.")
    ] = 30.0,
    queue: Annotated[
        int, typer.Option(min=0, help="Requests that may wait for a thread; more are refused.")
    ] = 32,
    ray: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Search in replicas of Ray Serve: local for a cluster on this machine, auto for "
            "the one that runs on it, or HOST:PORT. All nodes see the map under the same path.",
        ),
    ] = None,
    replicas: Annotated[
        int | None,
        typer.Option(min=1, show_default="2", help="With --ray: processes that hold each shard."),
    ] = None,
) -> None:
    """Answer where images were taken in a map, over HTTP.

    POST /localize takes an image or features, /docs describes it, /health and /metrics are for
    operators, and the page at / shows where a photo was taken. Ctrl-C and SIGTERM finish the
    requests in progress. Whoever reaches the port may ask: for TLS and passwords put a proxy before
    it.

    protomark serve kitchen
    """
    from contextlib import ExitStack

    from protomark.cli.terminal import note
    from protomark.extras import optional

    for module in ("fastapi", "fastapi_offline", "prometheus_client", "uvicorn"):
        optional(module)
    from protomark.localization.localizer import Localizer
    from protomark.serving.reading import Limits
    from protomark.serving.run import listen, serve_map

    if replicas is not None and ray is None:
        raise ValueError("--replicas is of --ray, which is missing")
    limits = Limits(max_megabytes, max_megapixels, timeout, threads, queue)
    with ExitStack() as until_end:
        opened: Path | ShardedMap = scene
        if ray is not None:
            from protomark.serving.replicas import replicated

            opened = until_end.enter_context(replicated(scene, ray, replicas or 2))
        localizer = Localizer(opened, max_keypoints=max_keypoints, max_size=max_size, recall=recall)
        at = until_end.enter_context(listen(host, port))
        count = f"{len(localizer.scene):,} landmarks"
        serve_map(
            scene, localizer, limits, at, lambda address: note(f"{address} serves {count}; /docs")
        )
    note("all requests are answered; stopped")
