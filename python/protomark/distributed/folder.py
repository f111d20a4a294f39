"""Files that all workers see: on a disk that they share, or in object storage."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit, urlunsplit

from protomark.extras import optional
from protomark.files import replacing


def is_url(text: str) -> bool:
    """Whether a text names something in object storage, such as s3://bucket/city."""
    return "://" in text


def shown(text: str) -> str:
    """A path or URL for messages and manifests, without what may be a secret."""
    if not is_url(text):
        return text
    parts = urlsplit(text)
    return urlunsplit((parts.scheme, parts.netloc.rpartition("@")[2], parts.path, "", ""))


def file_system(url: str) -> tuple[Any, str]:
    """Fsspec's file system of a path or URL, and the path there.

    Raises:
        ModuleNotFoundError: fsspec, or what it needs for this kind of URL, is not installed.
        ValueError: there is no such kind of URL.
    """
    fsspec = optional("fsspec")
    try:
        fs, path = fsspec.core.url_to_fs(url)
    except ImportError as error:
        raise ModuleNotFoundError(f"{shown(url)}: {error}") from None
    except ValueError as error:
        # What fsspec says may quote the URL.
        told = str(error).replace(url, shown(url))
        raise ValueError(f"{shown(url)} cannot be opened: {told}") from None
    return fs, str(path)


class Folder:
    """A folder of a shared disk or of object storage; files come into being whole."""

    def __init__(self, url: str) -> None:
        self.url = url
        self.local = None if is_url(url) else Path(url).absolute()

    def __str__(self) -> str:
        return shown(self.url)

    @contextmanager
    def workspace(self, name: str) -> Iterator[Path]:
        """Yield a folder of this machine for files to `publish`.

        On a shared disk it is `name` in this folder.
        """
        if self.local is not None:
            (self.local / name).mkdir(parents=True, exist_ok=True)
            yield self.local / name
            return
        with tempfile.TemporaryDirectory(prefix="protomark-") as folder:
            yield Path(folder)

    def publish(self, path: Path, name: str) -> None:
        """Move a file from the workspace to its place, where it appears as a whole."""
        if self.local is not None:
            path.replace(self.local / name)
        else:
            fs, target = self._target(name)
            fs.put_file(str(path), target)

    def fetch(self, name: str, folder: Path) -> Path:
        """A file as one of this machine, in `folder` if it has to be copied."""
        if self.local is not None:
            return self.local / name
        fs, root = file_system(self.url)
        fs.get_file(f"{root}/{name}", str(folder / Path(name).name))
        return folder / Path(name).name

    def write(self, name: str, content: bytes) -> None:
        """Write a small file, whole or not at all."""
        if self.local is not None:
            (self.local / name).parent.mkdir(parents=True, exist_ok=True)
            with replacing(self.local / name) as file:
                file.write(content)
        else:
            fs, target = self._target(name)
            fs.pipe_file(target, content)

    def _target(self, name: str) -> tuple[Any, str]:
        fs, root = file_system(self.url)
        target = f"{root}/{name}"
        fs.makedirs(target.rpartition("/")[0], exist_ok=True)
        return fs, target

    def read(self, name: str) -> bytes | None:
        """The content of a small file; None: there is none."""
        fs, root = file_system(self.url)
        try:
            return bytes(fs.cat_file(f"{root}/{name}"))
        except FileNotFoundError:
            return None

    def url_of(self, name: str) -> str:
        """The path or URL of a file."""
        return f"{self.url.rstrip('/')}/{name}"

    def size(self, name: str) -> int | None:
        """The bytes of a file; None: there is none."""
        fs, root = file_system(self.url)
        try:
            return int(fs.info(f"{root}/{name}")["size"])
        except FileNotFoundError:
            return None

    def names(self) -> list[str]:
        """The files in the folder, not in those below it."""
        fs, root = file_system(self.url)
        try:
            found = fs.ls(root, detail=True)
        except FileNotFoundError:
            return []
        return [os.path.basename(one["name"]) for one in found if one["type"] == "file"]

    def remove(self, name: str) -> None:
        """Remove a file, or a folder with all that is in it; nothing if there is none."""
        fs, root = file_system(self.url)
        if fs.exists(f"{root}/{name}"):
            fs.rm(f"{root}/{name}", recursive=True)
