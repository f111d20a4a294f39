"""Optional dependencies: imported on first use; the error names an absent one."""

from __future__ import annotations

import json
from importlib import import_module
from importlib.metadata import PackageNotFoundError, distribution
from typing import Any
from urllib.parse import unquote, urlparse

# Module -> its name, and the extra of this package that installs it.
_EXTRAS = {
    "PIL": ("Pillow", "serve"),
    "cv2": ("OpenCV (opencv-contrib-python-headless)", "localize"),
    "fastapi": ("FastAPI", "serve"),
    "fastapi_offline": ("fastapi-offline", "serve"),
    "fsspec": ("fsspec", "ray"),
    "matplotlib": ("matplotlib", "map"),
    "poselib": ("PoseLib", "localize"),
    "prometheus_client": ("prometheus-client", "serve"),
    "pycolmap": ("pycolmap", "localize"),
    "python_multipart": ("python-multipart", "serve"),
    "ray": ("Ray", "ray"),
    "rerun": ("the Rerun SDK (rerun-sdk)", "view"),
    "rich": ("Rich", "cli"),
    "rosbags": ("rosbags", "ros"),
    "safetensors": ("safetensors", "map"),
    "torch": ("PyTorch", "train"),
    "typer": ("Typer", "cli"),
    "uvicorn": ("uvicorn", "serve"),
}


def optional(module: str) -> Any:
    """Import a module that one of the package's extras installs.

    Raises:
        ModuleNotFoundError: the module is absent; the error says how to install it.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        root = (error.name or module).partition(".")[0]
        if root not in _EXTRAS:
            raise
        raise missing(root) from error


def missing(module: str) -> ModuleNotFoundError:
    """The error for an optional module that is absent."""
    name, extra = _EXTRAS[module]
    return ModuleNotFoundError(
        f"this needs {name}, which is not installed: {install_command(extra)}", name=module
    )


def install_command(extra: str) -> str:
    """The pip command that installs an extra, from the same clone as Protomark or from the index.

    pip records in direct_url.json where a package came from (PEP 610).
    """
    source = "protomark"
    try:
        record = distribution("protomark").read_text("direct_url.json")
        url = urlparse(json.loads(record)["url"]) if record else None
        if url is not None and url.scheme == "file" and not url.path.endswith((".whl", ".gz")):
            source = unquote(url.path)
    except (PackageNotFoundError, ValueError, KeyError):
        pass
    return f"pip install '{source}[{extra}]'"
