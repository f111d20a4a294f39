"""Files broken at random from seeds, and limits on the readers that refuse them."""

from __future__ import annotations

import faulthandler
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from map_container import container, sections

_LIBRARIES = os.environ.get("LD_PRELOAD", "")
# Of each kind; fewer under a sanitizer, which takes many times as long.
_SANITIZED = "libasan" in _LIBRARIES or "libtsan" in _LIBRARIES
FILES = 150 if _SANITIZED else 1500
SEED = int(os.environ.get("PROTOMARK_SEED", "0"))
_NUMBERS = (0, 1, 2, 4, 127, 128, 255, 2**15, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63)


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """The data with some bytes changed, removed, repeated or inserted."""
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        at, length = (int(rng.integers(0, max(1, len(changed)))) for _ in range(2))
        length = min(length, 64)
        match rng.integers(0, 6):
            case 0:
                changed[at : at + 1] = rng.bytes(1)
            case 1:
                changed[at : at + length] = b""
            case 2:
                changed[at:at] = rng.bytes(length)
            case 3:
                changed[at : at + length] = bytes(changed[length : 2 * length])
            case 4:
                width = int(rng.choice([1, 2, 4, 8]))
                number = _NUMBERS[int(rng.integers(0, len(_NUMBERS)))]
                at -= at % width
                changed[at : at + width] = (number % 256**width).to_bytes(width, "little")
            case _:
                del changed[at:]
    return bytes(changed)


def mutated_container(data: bytes, rng: np.random.Generator) -> bytes:
    """A file of docs/format.md with a change behind right checksums, or, one in four, anywhere."""
    if rng.integers(0, 4) == 0:
        return mutated(data, rng)
    version, kind = (int.from_bytes(data[a : a + 4], "little") for a in (8, 12))
    parts = sections(data)
    at = int(rng.integers(0, len(parts)))
    name, content = parts[at]
    match rng.integers(0, 12):
        case 0:
            version = int(rng.integers(0, 3))
        case 1:
            kind = int(rng.integers(0, 5))
        case 2:
            del parts[at]
        case 3:
            parts[at] = (name, parts[int(rng.integers(0, len(parts)))][1])
        case 4:
            parts.append((name[::-1], content))
        case _:
            change = mutated_container if name == "encoder" else mutated
            parts[at] = (name, change(content, rng))
    return container(parts, version, kind)


@contextmanager
def bounded(megabytes: int = 256, seconds: float = 300) -> Iterator[None]:
    """Limits a reader: too much memory raises MemoryError, a hang ends the process."""
    resource = None
    if not _SANITIZED:  # sanitizers themselves take all addresses
        import resource
    faulthandler.dump_traceback_later(seconds, exit=True)
    if resource is not None:
        old = resource.getrlimit(resource.RLIMIT_AS)
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + (megabytes << 20), old[1]))
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
        if resource is not None:
            resource.setrlimit(resource.RLIMIT_AS, old)
