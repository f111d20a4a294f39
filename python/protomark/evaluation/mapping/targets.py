"""What mapping was aimed at, and whether it is met."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from protomark.evaluation.mapping.variants import COLMAP, PROTOTYPES, TRADITIONAL

if TYPE_CHECKING:
    from protomark.evaluation.mapping.results import Results, SequenceResult

# What came out, and whether it is enough.
Measured = tuple[str, bool | None]
_NOTHING: Measured = ("", None)
MAX_ERROR, MAX_MEMORY, MIN_COLMAP = 1.05, 1 / 6, 0.95


@dataclass(frozen=True)
class Target:
    """One aim.

    Attributes:
        name: what it is about.
        wanted: in words.
        measured: sequence -> what came out, and whether that meets it; "" and None: not measured.
    """

    name: str
    wanted: str
    measured: dict[str, Measured]

    @property
    def met(self) -> bool | None:
        """Whether every sequence that was measured meets it; None: none was."""
        found = [met for _, met in self.measured.values() if met is not None]
        return all(found) if found else None


def targets(results: Results) -> list[Target]:
    """All targets, in the order in which they were set."""
    rows: list[tuple[str, str, Callable[[SequenceResult], Measured]]] = [
        ("registered frames", "at least as many as with all descriptors", _registered),
        ("trajectory error", "at most 1.05 of that with all descriptors, same frames", _error),
        ("descriptor memory", "at most 1/6 of all descriptors", _memory),
        ("matching time", "below that with all descriptors", _matching),
        ("beside COLMAP", "at least 95 % of the frames that COLMAP registers", _colmap),
        ("no drift", "the same bytes as a map made at once", _drift),
    ]
    found = []
    for name, wanted, measure in rows:
        measured = {s.name: measure(s) for s in results.sequences}
        found.append(Target(name, wanted, measured))
    found.append(
        Target(
            "localization",
            "recall at 5 cm and 5° not below that of all descriptors",
            {results.localized: _recall(results)} if results.recalls else {},
        )
    )
    return found


def _registered(s: SequenceResult) -> Measured:
    ours, theirs = s.runs.get(PROTOTYPES), s.runs.get(TRADITIONAL)
    if ours is None or theirs is None:
        return _NOTHING
    return f"{ours.registered} : {theirs.registered}", ours.registered >= theirs.registered


def _error(s: SequenceResult) -> Measured:
    ours, theirs = s.error(PROTOTYPES, TRADITIONAL), s.error(TRADITIONAL, PROTOTYPES)
    if ours is None or theirs is None:
        return _NOTHING
    return f"{ours / theirs:.2f}", ours <= MAX_ERROR * theirs


def _memory(s: SequenceResult) -> Measured:
    ours, theirs = s.runs.get(PROTOTYPES), s.runs.get(TRADITIONAL)
    if ours is None or theirs is None or not ours.memory_bytes or not theirs.memory_bytes:
        return _NOTHING
    share = ours.memory_bytes / theirs.memory_bytes
    return f"1/{1 / share:.1f}", share <= MAX_MEMORY


def _matching(s: SequenceResult) -> Measured:
    ours, theirs = s.runs.get(PROTOTYPES), s.runs.get(TRADITIONAL)
    if ours is None or theirs is None or not theirs.registered:
        return _NOTHING
    share = matching(ours.seconds) / matching(theirs.seconds)
    return f"{share:.2f}", share < 1


def matching(seconds: dict[str, float]) -> float:
    """Seconds of the stages that find a frame in the map: codes, matches and its pose."""
    return seconds.get("encode", 0.0) + seconds.get("match", 0.0)


def _colmap(s: SequenceResult) -> Measured:
    ours, theirs = s.runs.get(PROTOTYPES), s.runs.get(COLMAP)
    if ours is None or theirs is None:
        return _NOTHING
    enough = ours.registered >= MIN_COLMAP * theirs.registered
    return f"{ours.registered} : {theirs.registered}", enough


def _drift(s: SequenceResult) -> Measured:
    run = s.runs.get(PROTOTYPES)
    if run is None or run.drift is None:
        return _NOTHING
    drift = run.drift
    if drift.same_file:
        return "same bytes", True
    return f"{drift.unlike} of {drift.landmarks} landmarks differ", False


def _recall(results: Results) -> Measured:
    found = {r.variant: r.recall for r in results.recalls}
    if PROTOTYPES not in found or TRADITIONAL not in found:
        return _NOTHING
    ours, theirs = found[PROTOTYPES], found[TRADITIONAL]
    return f"{ours:.3f} : {theirs:.3f}", ours >= theirs
