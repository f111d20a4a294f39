"""Tells which descriptor the bytes of another program's features are."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from protomark.features.descriptors import DESCRIPTORS

# OpenMVG and others keep AKAZE's 61 bytes in 64.
_AKAZE_PADDED = 64


def binary_descriptor(name: str, dtype: str, size: int) -> str | None:
    """The descriptor of this name, with `size` numbers of a type; None if it is not binary.

    One of another length than Protomark's has its bits in its name, such as "teblid512".
    """
    if dtype != "uint8" or size >= 128:
        return None
    for known, kind in sorted(DESCRIPTORS.items(), key=lambda item: -len(item[0])):
        if known in name.lower():
            if size == kind.bytes or (known == "akaze" and size == _AKAZE_PADDED):
                return known
            return f"{known}{8 * size}" if size in (32, 64) else None
    by_size = {32: "orb", 61: "akaze"}
    return by_size.get(size) if not name else name.lower() if size <= 64 else None


def refusal(path: Path, program: str, found: Iterable[str]) -> ValueError:
    """The error for a data set without binary descriptors.

    Args:
        path: the data set.
        program: what wrote it.
        found: the descriptors that it has.
    """
    listed = " and ".join(sorted(found)) or "no"
    binary = [name.upper() for name, kind in DESCRIPTORS.items() if kind.input == "bits"]
    names = ", ".join(binary)
    return ValueError(
        f"{path}: this data set of {program} has {listed} descriptors, but Protomark takes binary "
        f"ones ({names}): describe its images anew with `protomark build images/ sparse/`, where "
        "sparse/ is its model exported to COLMAP"
    )
