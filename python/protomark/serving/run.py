"""Runs the service of a map until a signal ends it."""

from __future__ import annotations

import logging
import os
import signal
import socket
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import uvicorn

from protomark.extras import optional
from protomark.files import MANIFEST
from protomark.localization.localizer import Localizer
from protomark.maps.cameras import map_cameras
from protomark.maps.places import map_places
from protomark.maps.sharded_map import ShardedMap
from protomark.serving.metrics import log
from protomark.serving.reading import Limits
from protomark.serving.service import make_app
from protomark.serving.top_view import keyframe_poses, top_view
from protomark.threads import one_blas_thread

# Between two looks at the manifest of a folder of shards.
_LOOK_SECONDS = 2.0
# Proxies keep connections for 60 s; one that is closed under their hands fails a request.
_IDLE_SECONDS = 75
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def listen(host: str, port: int) -> socket.socket:
    """A socket that takes connections; of port 0, at any free port.

    Raises:
        OSError: the address is not this machine's, or the port is taken.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=2048)
    except (OSError, OverflowError) as error:
        raise OSError(
            f"nothing can listen at {host}, port {port} ({error}): name others with --host, --port"
        ) from None


def serve_map(
    path: Path,
    localizer: Localizer,
    limits: Limits,
    at: socket.socket,
    started: Callable[[str], None],
) -> None:
    """Serve a map until SIGINT or SIGTERM, and then finish the requests in progress.

    Args:
        path: the map's file or folder.
        localizer: the map, opened.
        limits: what the server takes.
        at: see `listen`.
        started: called with the server's address.
    """
    # OpenCV reads it when it is imported: a second check, should an image's header lie.
    os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"] = str(int(1e6 * limits.megapixels))
    for module in ("cv2", "poselib", "PIL.Image", "safetensors.numpy", "python_multipart"):
        optional(module)  # what is missing shows now, and the first request is as fast as others
    import protomark.geometry.colmap  # noqa: F401

    for number in _SIGNALS:  # libraries take them for themselves
        signal.signal(number, signal.default_int_handler)
    warnings.simplefilter("ignore")  # about cameras of requests: they stand in the answers
    _log_requests()
    poses = keyframe_poses(path)
    app = make_app(localizer, limits, lambda: top_view(localizer.scene, localizer.places, poses))
    config = uvicorn.Config(
        app,
        http="h11",
        ws="none",
        lifespan="off",
        log_config=None,
        log_level="error",
        access_log=False,
        server_header=False,
        timeout_keep_alive=_IDLE_SECONDS,
        timeout_graceful_shutdown=int(limits.seconds) + 1,
    )
    host, port = at.getsockname()[:2]
    started(f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}")
    ended = threading.Event()
    follower = threading.Thread(target=_follow, args=(localizer, ended))
    follower.start()
    try:
        with one_blas_thread():
            uvicorn.Server(config).run(sockets=[at])
    except KeyboardInterrupt:
        pass  # uvicorn raises the signal again once all is done
    finally:
        for number in _SIGNALS:  # one was enough
            signal.signal(number, signal.SIG_IGN)
        ended.set()
        follower.join()
        app.state.workers.close()


def _follow(localizer: Localizer, ended: threading.Event) -> None:
    """Take over the shards of a folder as its manifest names others."""
    scene = localizer.scene
    if not isinstance(scene, ShardedMap):
        return
    manifest = scene.path / MANIFEST
    seen = file_version(manifest)
    while not ended.wait(_LOOK_SECONDS):
        if (now := file_version(manifest)) in (seen, None):
            continue
        seen = now
        try:
            scene.refresh()
            localizer.cameras = map_cameras(scene)
            localizer.places = map_places(scene.metadata)
        except (OSError, ValueError) as error:
            log.error("the map stays as it was: %s", error)
        else:
            log.info("the map has %d shards, %d landmarks", len(scene.shards), len(scene))


def file_version(path: Path) -> tuple[int, int] | None:
    """What changes when a file is replaced; None if there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns


def _log_requests() -> None:
    handler = logging.StreamHandler()
    lines = logging.Formatter("%(asctime)s %(message)s", "%Y-%m-%dT%H:%M:%SZ")
    lines.converter = time.gmtime
    handler.setFormatter(lines)
    log.propagate = False
    log.setLevel(logging.INFO)
    log.addHandler(handler)
