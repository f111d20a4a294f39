"""Runs the service of a map until a signal ends it."""

from __future__ import annotations

import logging
import os
import socket
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import uvicorn

from protomark.extras import optional
from protomark.localization.localizer import Localizer
from protomark.serving.reading import Limits
from protomark.serving.service import make_app
from protomark.serving.top_view import keyframe_poses, top_view
from protomark.threads import one_blas_thread


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
    import protomark.geometry.colmap  # noqa: F401  (in the main thread: it mends a signal handler)

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
        timeout_graceful_shutdown=int(limits.seconds) + 1,
    )
    host, port = at.getsockname()[:2]
    started(f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}")
    try:
        with one_blas_thread():
            uvicorn.Server(config).run(sockets=[at])
    except KeyboardInterrupt:
        pass  # uvicorn raises the signal again once all is done
    finally:
        app.state.workers.close()


def _log_requests() -> None:
    handler = logging.StreamHandler()
    lines = logging.Formatter("%(asctime)s %(message)s", "%Y-%m-%dT%H:%M:%SZ")
    lines.converter = time.gmtime
    handler.setFormatter(lines)
    log = logging.getLogger("protomark.serving")
    log.setLevel(logging.INFO)
    log.addHandler(handler)
