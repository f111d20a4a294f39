"""Writes files atomically, after a check that they can be written, and sorts their names."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import hashlib
import os
import re
import secrets
import shutil
import socket
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

# The maps in the folder that `protomark map` writes: the one that learns, and the one that ships.
SCENE_MAP = "scene.pmk"
SEALED_MAP = "scene.sealed.pmk"
# Beside them, what a later run continues with, and what observed the landmarks.
STATE = "state.safetensors"
# What a folder of shards holds.
MANIFEST = "manifest.json"


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Yield a new file that replaces `path` when the block ends without an error.

    On an error, Ctrl-C included, the old file stays and nothing else is left. After the block the
    new file survives a power cut and has the permission bits of the old one. A killed process may
    leave `.<name>.<random>`, which nothing reads.
    """
    # Links are written through: whoever made one wants the file that it leads to.
    target = Path(path).resolve()
    if target.exists() and not target.is_file():
        raise OSError(errno.EINVAL, "not a regular file, so it cannot be replaced", str(path))
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}")
    # Not tempfile: only the owner may read its files.
    mode = _permissions(target)
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
    handle = os.open(temporary, flags, 0o666 if mode is None else mode)
    try:
        with os.fdopen(handle, "wb") as file:
            if mode is not None:
                # The umask may have removed bits. If this fails, fewer users may read the file.
                with suppress(OSError):
                    os.fchmod(handle, mode)
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except BaseException:
        os.unlink(temporary)
        raise
    _sync_folder(target.parent)


@contextmanager
def replacing_folder(folder: Path) -> Iterator[Path]:
    """Yield a new folder that replaces `folder` when the block ends without an error.

    On an error, Ctrl-C included, the old folder stays.
    """
    temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    temporary.chmod(0o755)
    old = folder.with_name(f".{folder.name}.old")
    try:
        yield temporary
        if not folder.exists():
            temporary.rename(folder)
        elif not _exchange(temporary, folder):
            shutil.rmtree(old, ignore_errors=True)
            folder.rename(old)
            temporary.rename(folder)
    except BaseException:
        if old.exists() and not folder.exists():  # between the two renames
            old.rename(folder)
        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    shutil.rmtree(old, ignore_errors=True)


def _exchange(one: Path, other: Path) -> bool:
    """Swap two folders in one step, which no kill can interrupt; False where that cannot be."""
    rename = getattr(ctypes.CDLL(None), "renameat2", None)
    at_cwd, exchange = -100, 2
    return (
        rename is not None
        and rename(at_cwd, os.fsencode(one), at_cwd, os.fsencode(other), exchange) == 0
    )


def _permissions(path: Path) -> int | None:
    """The permission bits of a file, None if it does not exist."""
    try:
        return path.stat().st_mode & 0o777
    except OSError:
        return None


def _sync_folder(folder: Path) -> None:
    """Make a rename survive a power cut."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except PermissionError:  # the folder is writable but not readable
        return
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(handle)


@contextmanager
def only_writer(folder: Path, name: str = "") -> Iterator[None]:
    """Keep other processes from writing to a folder, or to one file in it, during the block.

    The folder is made, and removed again if nothing is in it in the end.

    Raises:
        NotADirectoryError: it is a file.
        BlockingIOError: another process writes there.
    """
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(f"{folder} is not a folder: name one with -o")
    existed = folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f".lock{name and '-' + name}"
    handle = _lock(path)
    try:
        os.ftruncate(handle, 0)
        os.write(handle, f"process {os.getpid()} on {socket.gethostname()}".encode())
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(handle)
        if not existed:
            with suppress(OSError):  # it holds something
                folder.rmdir()


def _lock(path: Path) -> int:
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if path.exists() and os.path.samestat(os.fstat(handle), path.stat()):
                return handle
        except BlockingIOError:
            owner = path.read_text(errors="replace") or "another process"
            os.close(handle)
            raise BlockingIOError(
                f"{path.parent}: {owner} is writing there: wait for it, or name another folder"
            ) from None
        except OSError as error:
            if error.errno not in (errno.ENOTSUP, errno.ENOLCK):
                raise
            return handle  # a file system without locks
        os.close(handle)  # its last owner has just removed it


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a UTF-8 text file atomically."""
    with replacing(path) as file:
        file.write(text.encode())


def check_outputs(
    *outputs: Path | None,
    inputs: Iterable[object] = (),
    folder: Path | None = None,
    maps: Sequence[Path | None] = (),
) -> None:
    """Raise before any work if a result could not be written after it, or would replace an input.

    Maps end in .pmk and nothing else does, so that neither replaces the other by mistake.

    Args:
        outputs: files to write; None: not asked for.
        inputs: what the command reads: paths, texts that may be paths, or None.
        folder: folder of further files to write, see `check_folder`.
        maps: map files to write; None: not asked for.
    """
    if folder is not None:
        check_folder(folder)
    written: list[Path] = []
    read = [Path(str(i)) for i in inputs if i is not None]
    named = [(path, True) for path in maps] + [(path, False) for path in outputs]
    for path, is_map in named:
        if path is None:
            continue
        if path.is_dir():
            raise ValueError(f"{path} is a folder: name a file to write")
        if path.exists() and not path.is_file():
            raise ValueError(f"{path} is not a regular file: name a file to write")
        if not path.parent.is_dir():
            raise FileNotFoundError(f"{path.parent}: no such folder to write {path.name} to")
        check_folder(path.parent)
        if any(_same_file(path, other) for other in read):
            raise ValueError(f"{path} is an input of this command: name another file to write")
        inside = any(other.is_dir() and _is_within(path, other) for other in read)
        if path.exists() and inside and path.suffix not in (".pmk", ".ply", ".json"):
            raise ValueError(f"{path} is part of an input of this command: name another file")
        folders = [one for other in read for one in (other, other.parent)]
        own = path.name != SCENE_MAP and any(_same_file(path.parent, f) for f in folders)
        if is_map and not own and (path.parent / STATE).is_file():
            raise ValueError(
                f"{path.parent} is the folder of a map, whose files belong together: name a file "
                "elsewhere"
            )
        if any(_same_file(path, other) for other in written):
            raise ValueError(f"{path} would be written twice: name different files")
        if (path.suffix == ".pmk") != is_map:
            wanted = "a map's file ends" if is_map else "only a map's file ends"
            raise ValueError(f"{path}: {wanted} in .pmk: name another file to write")
        written.append(path)


def check_folder(folder: Path) -> None:
    """Raise before any work if no file could be written to a folder, which need not exist.

    Raises:
        NotADirectoryError: it is a file.
        OSError: the folder is read-only, for example.
    """
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise NotADirectoryError(f"{existing} is not a folder: name one with -o")
    try:
        tempfile.TemporaryFile(dir=existing).close()
    except OSError as error:
        reason = error.strerror or error
        raise OSError(f"{existing}: no file can be written to this folder ({reason})") from None


def check_elsewhere(folder: Path) -> None:
    """Raise if a folder to replace is the current one: the shell would stay in the old one."""
    if folder.resolve() == Path.cwd():
        raise ValueError(f"{folder} is the folder you are in, and is replaced: leave it first")


def _is_within(path: Path, folder: Path) -> bool:
    return path.resolve().is_relative_to(folder.resolve())


def _same_file(path: Path, other: Path) -> bool:
    try:
        return path.resolve() == other.resolve() or path.samefile(other)
    except (OSError, RuntimeError):  # one does not exist, or links go round in circles
        return False


def hash_files(named: Iterable[tuple[str, Path]]) -> str:
    """SHA-256, hexadecimal, of names and of the content of their files."""
    digest = hashlib.sha256()
    for name, path in named:
        digest.update(f"{name}\0{path.stat().st_size}\0".encode(errors="surrogateescape"))
        with path.open("rb") as file:
            while block := file.read(1 << 16):
                digest.update(block)
    return digest.hexdigest()


def natural_key(name: str) -> list[tuple[int, str]]:
    """Sort key under which frame2 comes before frame10."""
    return [(int(p), "") if p.isdecimal() else (-1, p) for p in re.split(r"(\d+)", name)]


def is_utf8(text: str) -> bool:
    """Whether a text, such as a file name, can be written to a text file."""
    return not re.search("[\ud800-\udfff]", text)
