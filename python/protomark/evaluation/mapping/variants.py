"""What a map may remember of descriptors: the same pipeline runs with each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from protomark.mapping.settings import Settings

TRADITIONAL, COLMAP = "traditional", "colmap"
# What the targets are about.
PROTOTYPES = "prototypes-32"


@dataclass(frozen=True)
class Variant:
    """One memory.

    Attributes:
        name: on the command line and in files.
        label: what tables say.
        memory: see `protomark.mapping.settings.Settings`.
        dim: dimensions of a prototype.
    """

    name: str
    label: str
    memory: str
    dim: int = 32

    def settings(self, base: Settings) -> Settings:
        """How to make a map with it, all else as in `base`."""
        return replace(base, memory=self.memory, dim=self.dim)


VARIANTS = (
    Variant(TRADITIONAL, "all descriptors", "descriptors"),
    Variant("medoid", "medoid", "medoids"),
    Variant(PROTOTYPES, "prototypes, 32", "prototypes", 32),
    Variant("prototypes-16", "prototypes, 16", "prototypes", 16),
)
LABELS = {v.name: v.label for v in VARIANTS} | {COLMAP: "COLMAP, SIFT"}


def choose(names: Sequence[str]) -> list[Variant]:
    """The variants of these names, in the order of tables; none named: all.

    Raises:
        ValueError: there is no variant of some name.
    """
    known = {v.name: v for v in VARIANTS}
    for name in names:
        if name not in known:
            raise ValueError(f"there is no variant {name!r}: choose from {', '.join(known)}")
    return [v for v in VARIANTS if not names or v.name in names]
