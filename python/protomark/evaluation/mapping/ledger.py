"""Prototypes that also write down what they were given, so that the map can be made again."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.mapping.memory import Prototypes

Ids = NDArray[np.int64]


class Ledger(Prototypes):
    """A memory of prototypes with a list of all that was done to it.

    Writing down costs next to nothing while frames come in; `held` goes through the list later.
    """

    def __init__(self, encoder: pm.Encoder, dim: int) -> None:
        super().__init__(encoder, dim)
        self._log: list[tuple[str, Ids, NDArray[Any]]] = []

    def add(self, ids: Ids, encoded: NDArray[Any]) -> None:
        """See `Memory.add`."""
        super().add(ids, encoded)
        self._log.append(("add", ids.copy(), encoded.copy()))

    def remove(self, ids: Ids, encoded: NDArray[Any]) -> None:
        """See `Memory.remove`."""
        super().remove(ids, encoded)
        self._log.append(("remove", ids.copy(), encoded.copy()))

    def merge(self, into: Ids, source: Ids) -> None:
        """See `Memory.merge`."""
        super().merge(into, source)
        self._log.append(("merge", into.copy(), source.copy()))

    def discard(self, ids: Ids) -> None:
        """See `Memory.discard`."""
        super().discard(ids)
        self._log.append(("discard", ids.copy(), ids[:0]))

    def held(self) -> tuple[Ids, NDArray[np.int8]]:
        """Landmark (n,) and code (n, dim) of all observations that are in the prototypes."""
        codes: dict[int, list[bytes]] = {}
        for what, ids, given in self._log:
            if what == "discard":
                for i in ids.tolist():
                    codes.pop(i, None)
            elif what == "merge":
                for into, source in zip(ids.tolist(), given.tolist(), strict=True):
                    codes.setdefault(into, []).extend(codes.pop(source, []))
            else:
                for i, code in zip(ids.tolist(), given, strict=True):
                    if what == "add":
                        codes.setdefault(i, []).append(code.tobytes())
                    else:
                        codes[i].remove(code.tobytes())
        ids = np.repeat(np.array(list(codes), np.int64), [len(c) for c in codes.values()])
        joined = b"".join(code for one in codes.values() for code in one)
        return ids, np.frombuffer(joined, np.int8).reshape(-1, self.dim)
