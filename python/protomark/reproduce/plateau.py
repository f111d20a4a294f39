"""The paper's schedule: a tenth of the rate when the validation loss stagnates."""

from __future__ import annotations

RATE = 0.001
FACTOR = 0.1
DROPS = 2
# With a limit of steps the rate falls at the latest when this share of them is done.
_LATEST_DROP = 0.8


class Plateau:
    """The learning rate, epoch by epoch.

    The paper names the first rate, the factor and the reason to fall. When to end is left open:
    here at the third plateau, at a rate of 0.00001. A training that is limited to some steps ends
    there, and its last fifth runs at a tenth of the rate at least, so that its end is not noisy.

    Args:
        patience: epochs without a lower loss that make a plateau.
        steps: limit of the training, None for none.

    Attributes:
        rate: the learning rate to use now.
        drops: how often it fell.
        best: the lowest loss so far.
        finished: whether training is over.
    """

    def __init__(self, patience: int, steps: int | None = None) -> None:
        self.patience = patience
        self.steps = steps
        self.rate = RATE
        self.drops = 0
        self.best = float("inf")
        self.finished = False
        self._stale = 0

    def update(self, step: int, loss: float) -> bool:
        """Take the validation loss after `step` steps; says whether it is the lowest so far."""
        better = loss < self.best
        if better:
            self.best, self._stale = loss, 0
        else:
            self._stale += 1
        late = self.steps is not None and step >= _LATEST_DROP * self.steps and self.drops == 0
        if self._stale >= self.patience or late:
            self._fall()
        if self.steps is not None and step >= self.steps:
            self.finished = True
        return better

    def _fall(self) -> None:
        self._stale = 0
        if self.drops == DROPS:
            self.finished = True
            return
        self.drops += 1
        self.rate *= FACTOR
