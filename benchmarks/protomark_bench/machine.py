"""Describes the machine of a measurement: its CPU, free memory and ceilings."""

from __future__ import annotations

import ctypes
import gc
import platform
import shutil
import sys
import tempfile
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from protomark.threads import available_threads


def describe(*distributions: str) -> dict[str, str]:
    """CPU, instruction set in use, cores, memory, system, date and versions."""
    import protomark as pm

    facts = {
        "CPU": cpu_model(),
        "instruction set in use": pm.instruction_set(),
        "cores": str(available_threads()),
        "system": f"{platform.system()} {platform.machine()}",
        "measured on": datetime.now(timezone.utc).date().isoformat(),
        "Python": platform.python_version(),
    }
    memory = memory_bytes("MemTotal")
    if memory is not None:
        facts["memory"] = f"{memory / 2**30:.0f} GiB"
    for distribution in ("protomark", *distributions):
        try:
            facts[distribution] = version(distribution)
        except PackageNotFoundError:
            continue
    return facts


def cpu_model() -> str:
    """The model name of the CPU."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def last_level_cache() -> int:
    """Bytes of the largest cache of a core; 64 MiB if the system does not tell."""
    sizes = []
    for path in Path("/sys/devices/system/cpu/cpu0/cache").glob("index*/size"):
        size = path.read_text().strip()
        if size.endswith("K") and size[:-1].isdigit():
            sizes.append(1024 * int(size[:-1]))
    return max(sizes, default=1 << 26)


def memory_bytes(field: str) -> int | None:
    """A field of /proc/meminfo in bytes, None if it does not exist."""
    if not sys.platform.startswith("linux"):
        return None
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith(field + ":"):
            return 1024 * int(line.split()[1])
    return None


class _MallocInfo(ctypes.Structure):
    """struct mallinfo2 of glibc."""

    _fields_ = (
        ("arena", ctypes.c_size_t * 4),
        ("hblkhd", ctypes.c_size_t),
        ("between", ctypes.c_size_t * 2),
        ("uordblks", ctypes.c_size_t),
        ("rest", ctypes.c_size_t * 2),
    )


def allocated_bytes() -> int | None:
    """Bytes that this process has allocated and not freed; None without glibc 2.33 or newer."""
    gc.collect()
    try:
        mallinfo = ctypes.CDLL(None).mallinfo2
    except (AttributeError, OSError, TypeError):
        return None
    mallinfo.restype = _MallocInfo
    info = mallinfo()
    return int(info.uordblks + info.hblkhd)


def shortage(memory: float, disk: float = 0) -> str | None:
    """A sentence if so much memory or temporary disk is not free, None if it is."""
    free = memory_bytes("MemAvailable")
    if free is not None and free < memory:
        return f"needs {memory / 2**30:.1f} GiB of memory, {free / 2**30:.1f} GiB are free"
    folder = tempfile.gettempdir()
    if shutil.disk_usage(folder).free < disk:
        return f"needs {disk / 2**30:.1f} GiB of disk at {folder}"
    return None


def ceilings(seconds: float) -> dict[str, float]:
    """Measure the highest rates of one thread, for `seconds` each.

    Returns:
        int8 multiply-adds per second for each instruction set of this CPU, and under "read" the
        bytes per second that are read from beyond all caches, unless memory is short.
    """
    from protomark_bench import _ceilings

    rates = dict(_ceilings.multiply_adds(seconds))
    size = max(1 << 28, 4 * last_level_cache())
    if shortage(size) is None:
        rates["read"] = _ceilings.read_bytes(size, seconds)
    return rates
