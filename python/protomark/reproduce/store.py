"""Finished trainings and measurements, kept in files so that a run that was cut goes on."""

from __future__ import annotations

import json
from pathlib import Path

from protomark.files import replacing
from protomark.kept import Kept
from protomark.reproduce.trainer import Outcome


class Store(Kept):
    """Trainings beside measurements, see `Kept`."""

    def save_outcome(self, key: str, outcome: Outcome) -> None:
        """Keep a training: its weights, and the rest as JSON in the header."""
        from safetensors.numpy import save

        facts = {name: value for name, value in vars(outcome).items() if name != "weights"}
        with replacing(self._outcome(key)) as file:
            file.write(save(outcome.weights, metadata={"outcome": json.dumps(facts)}))

    def load_outcome(self, key: str) -> Outcome | None:
        """A kept training, None if it is not there."""
        from safetensors import SafetensorError, safe_open

        path = self._outcome(key)
        if not path.is_file():
            return None
        try:
            with safe_open(path, framework="numpy") as file:
                facts = json.loads((file.metadata() or {})["outcome"])
                weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            facts["history"] = [tuple(entry) for entry in facts["history"]]
            return Outcome(weights=weights, **facts)
        except (SafetensorError, ValueError, KeyError, TypeError, OSError):
            return None

    def _outcome(self, key: str) -> Path:
        return self.folder / f"training.{key}.safetensors"
