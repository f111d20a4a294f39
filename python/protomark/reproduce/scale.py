"""How long a reproduction trains, and on which sequences."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Scale:
    """One of small, medium and full.

    Attributes:
        name: what `--scale` takes.
        steps: batches of one training at most, None to go on until the plateaus end it.
        epoch: batches between two looks at the validation loss.
        patience: epochs without a lower validation loss after which the rate falls.
        quick: whether only the sequences whose tracks are quickly made take part.
    """

    name: str
    steps: int | None
    epoch: int
    patience: int
    quick: bool = False

    @property
    def expected_steps(self) -> int:
        """Steps of a training, for the time left; a guess where plateaus end it."""
        return self.steps or 60 * self.epoch


SCALES = {
    scale.name: scale
    for scale in (
        Scale("small", steps=600, epoch=50, patience=3, quick=True),
        Scale("medium", steps=1500, epoch=100, patience=3),
        Scale("full", steps=None, epoch=250, patience=5),
    )
}


def find_scale(name: str) -> Scale:
    """The scale of this name. Raises ValueError if there is none."""
    if name not in SCALES:
        raise ValueError(f"--scale {name!r} is not known: give {', '.join(SCALES)}")
    return SCALES[name]
