"""The machine that a bench runs on."""

from __future__ import annotations

import ctypes
import gc
import platform
import shutil
import sys
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from protomark.bench.results import Results
from protomark.evaluation.threads import available_threads


def describe() -> dict[str, str]:
    """CPU, instruction set in use, cores, memory, system and versions."""
    import protomark as pm

    facts = {
        "CPU": cpu_model(),
        "instruction set in use": pm.instruction_set(),
        "cores": str(available_threads()),
        "system": f"{platform.system()} {platform.machine()}",
        "Python": platform.python_version(),
        "protomark": pm.__version__,
        "measured on": datetime.now(timezone.utc).date().isoformat(),
    }
    memory = memory_bytes("MemTotal")
    if memory is not None:
        facts["memory"] = f"{memory / 2**30:.0f} GiB"
    return facts


def cpu_model() -> str:
    """What the CPU calls itself."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def last_level_cache() -> int:
    """Bytes of the largest cache that a core uses, shared or not; 64 MB where nothing says so."""
    sizes = []
    for path in Path("/sys/devices/system/cpu/cpu0/cache").glob("index*/size"):
        size = path.read_text().strip()
        if size.endswith("K") and size[:-1].isdigit():
            sizes.append(1024 * int(size[:-1]))
    return max(sizes, default=1 << 26)


def versions(distributions: dict[str, str]) -> dict[str, str]:
    """Name -> installed version of a distribution, absent ones left out."""
    found = {}
    for name, distribution in distributions.items():
        try:
            found[name] = version(distribution)
        except PackageNotFoundError:
            continue
    return found


def memory_bytes(field: str) -> int | None:
    """A field of /proc/meminfo in bytes, None where there is none."""
    if not sys.platform.startswith("linux"):
        return None
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith(field + ":"):
            return 1024 * int(line.split()[1])
    return None


class _MallocInfo(ctypes.Structure):
    """struct mallinfo2 of glibc."""

    _fields_ = tuple(
        (name, ctypes.c_size_t)
        for name in (
            "arena",
            "ordblks",
            "smblks",
            "hblks",
            "hblkhd",
            "usmblks",
            "fsmblks",
            "uordblks",
            "fordblks",
            "keepcost",
        )
    )


def allocated_bytes() -> int | None:
    """Memory that this process has allocated and not freed; None without glibc 2.33 or newer."""
    gc.collect()
    try:
        mallinfo = ctypes.CDLL(None).mallinfo2
    except (AttributeError, OSError, TypeError):
        return None
    mallinfo.restype = _MallocInfo
    info = mallinfo()
    return int(info.uordblks + info.hblkhd)


def lacks(memory: float, disk: float = 0, folder: Path | None = None) -> str | None:
    """What keeps work from these bytes of memory and disk, None where nothing does."""
    free = memory_bytes("MemAvailable")
    if free is not None and free < memory:
        return f"needs {memory / 2**30:.1f} GiB of memory, {free / 2**30:.1f} GiB are free"
    if folder is not None and shutil.disk_usage(folder).free < disk:
        return f"needs {disk / 2**30:.1f} GiB of disk at {folder}"
    return None


def measure_ceilings(results: Results, seconds: float) -> None:
    """Multiply-adds and reading of one thread; it reads from more memory than caches hold."""
    from protomark import _ceilings

    results.ceilings = _ceilings.multiply_adds(seconds)
    size = max(1 << 28, 4 * last_level_cache())
    reason = lacks(size)
    if reason:
        results.skipped.append(f"reading from memory: {reason}")
    else:
        results.ceilings["read"] = _ceilings.read_bytes(size, seconds)
