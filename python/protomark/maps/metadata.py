"""Metadata that commands write into a map; the library itself writes none."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from datetime import datetime, timezone


def creation_time() -> str:
    """The time in UTC, such as 2026-11-23T03:39:41Z, or that of SOURCE_DATE_EPOCH.

    The variable makes builds repeatable (https://reproducible-builds.org/specs/source-date-epoch).
    """
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    try:
        seconds = time.time() if epoch is None else int(epoch)
        if seconds < 0:
            raise ValueError
        utc = datetime.fromtimestamp(seconds, timezone.utc)
    except (ValueError, OverflowError, OSError):
        raise ValueError(
            f"SOURCE_DATE_EPOCH={epoch} is not a number of seconds since 1970: unset or correct it"
        ) from None
    return utc.strftime("%Y-%m-%dT%H:%M:%SZ")


def command_metadata(frame: str | None, pairs: Sequence[str]) -> dict[str, str]:
    """The metadata of a map that a command makes: "created", "frame" and the given pairs."""
    metadata = {"created": creation_time()}
    if frame is not None:
        metadata["frame"] = frame
    for pair in pairs:
        name, separator, text = pair.partition("=")
        if not separator:
            raise ValueError(f"--metadata {pair!r} is not of the form NAME=TEXT")
        metadata[name] = text
    return metadata
