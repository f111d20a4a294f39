"""Memory that this process holds, as glibc counts it."""

from __future__ import annotations

import ctypes
import gc


class _MallocInfo(ctypes.Structure):
    """struct mallinfo2; what lies in between is of no use here."""

    _fields_ = (
        ("arena", ctypes.c_size_t * 4),
        ("hblkhd", ctypes.c_size_t),
        ("between", ctypes.c_size_t * 2),
        ("uordblks", ctypes.c_size_t),
        ("rest", ctypes.c_size_t * 2),
    )


def allocated_bytes() -> int | None:
    """Memory that was allocated and not freed; None without glibc 2.33 or newer."""
    gc.collect()
    try:
        mallinfo = ctypes.CDLL(None).mallinfo2
    except (AttributeError, OSError, TypeError):
        return None
    mallinfo.restype = _MallocInfo
    info = mallinfo()
    return int(info.uordblks + info.hblkhd)
