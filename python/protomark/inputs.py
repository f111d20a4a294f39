"""What may follow a descriptor's own bits: nothing, angle and size (upright), or size (sized)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from protomark import sized, upright

if TYPE_CHECKING:
    from protomark.tracks.file import Tracks

_LONGER: dict[str, Callable[[Tracks], Tracks]] = {
    upright.SUFFIX: upright.upright_tracks,
    sized.SUFFIX: sized.sized_tracks,
}


def chosen(upright_too: bool, sized_too: bool) -> str:
    """The inputs that the options --upright and --sized ask for, "" without either.

    Raises:
        ValueError: both are given.
    """
    if upright_too and sized_too:
        raise ValueError("--upright has the sizes in it already: give --upright or --sized")
    return upright.SUFFIX if upright_too else sized.SUFFIX if sized_too else ""


def lengthen(tracks: Tracks, inputs: str) -> Tracks:
    """The tracks with further inputs: "" for none, "-upright" or "-sized".

    Raises:
        ValueError: the tracks do not have them.
    """
    return _LONGER[inputs](tracks) if inputs else tracks


def lacking(descriptor: str, wanted: str) -> str:
    """The inputs that make tracks of `descriptor` those of the descriptor `wanted`, or ""."""
    return next((inputs for inputs in _LONGER if wanted == descriptor + inputs), "")


def option(inputs: str) -> str:
    """The option of commands that adds the inputs, for example "--upright"."""
    return f"-{inputs}"
