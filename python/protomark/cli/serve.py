"""The command `protomark serve`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protomark.cli.options import MaxKeypoints, MaxSize, Threads


def serve(
    scene: Annotated[
        Path,
        typer.Argument(
            metavar="MAP", help="Map file (.pmk) with positions, or a folder of `protomark map`."
        ),
    ],
    host: Annotated[
        str, typer.Option(help="Address to listen at; 0.0.0.0 for all of this machine.")
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port; 0 for any that is free.")
    ] = 8000,
    max_keypoints: MaxKeypoints = 2000,
    max_size: MaxSize = 1600,
    recall: Annotated[
        float | None,
        typer.Option(
            min=0,
            max=1,
            help="Search a map with an index approximately: share of nearest landmarks that are "
            "found, for example 0.98. Without it the search is exact.",
        ),
    ] = None,
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
) -> None:
    """Answer where images were taken in a map, over HTTP.

    POST /localize takes an image or features, /docs describes it, /health and /metrics are for
    operators, and the page at / shows where a photo was taken. Ctrl-C and SIGTERM finish the
    requests in progress. Whoever reaches the port may ask: for TLS and passwords put a proxy before
    it.

    protomark serve kitchen
    """
    from protomark.cli.terminal import note
    from protomark.extras import optional

    for module in ("fastapi", "fastapi_offline", "prometheus_client", "uvicorn"):
        optional(module)
    from protomark.localization.localizer import Localizer
    from protomark.serving.reading import Limits
    from protomark.serving.run import listen, serve_map

    limits = Limits(max_megabytes, max_megapixels, timeout, threads, queue)
    localizer = Localizer(scene, max_keypoints=max_keypoints, max_size=max_size, recall=recall)
    with listen(host, port) as at:
        count = f"{len(localizer.scene):,} landmarks"
        serve_map(
            scene, localizer, limits, at, lambda address: note(f"{address} serves {count}; /docs")
        )
    note("all requests are answered; stopped")
