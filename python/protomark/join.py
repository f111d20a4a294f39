"""Maps that were built apart become one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import protomark as pm
from protomark.console import track

MAX_ID = 2**63 - 1


def join_files(inputs: Sequence[Path], output: Path, renumber: bool = False) -> dict[str, Any]:
    """Join open maps, in this order, into the map file `output`; facts about it as JSON values.

    Args:
        inputs: map files of the same encoder, dimensions and look bits.
        output: the file to write; none of the inputs.
        renumber: landmarks of different files are different landmarks, whatever their ids: those of
            each further file get new ones, above all before it.

    Raises:
        ValueError: fewer than two inputs, one twice, a sealed one, one that does not fit the first,
            or one that is the output.
        OSError: a file cannot be read or written.
    """
    check_inputs(inputs, output)
    files: list[dict[str, Any]] = []
    whole: pm.PrototypeMap | None = None
    for path in track(inputs, "joining"):
        scene = open_map(path)
        facts = {"file": str(path), "landmarks": len(scene), "in_common": 0}
        if whole is None:
            whole = scene
        else:
            before = len(whole)
            try:
                if renumber:
                    _take_over(whole, scene)
                else:
                    whole.update(scene)
            except ValueError as error:
                raise ValueError(f"{path}: {error}") from None
            facts["in_common"] = before + len(scene) - len(whole)
        files.append(facts)
    assert whole is not None
    whole.save(output)
    return {
        "kind": "open map",
        "inputs": files,
        "landmarks": len(whole),
        "dim": whole.dim,
        "look_bits": whole.look_bits or None,
        "bytes": output.stat().st_size,
    }


def show(facts: dict[str, Any]) -> None:
    """Print what `join_files` returned."""
    from rich.markup import escape
    from rich.table import Table

    from protomark.console import console

    table = Table.grid(padding=(0, 2))
    for i, one in enumerate(facts["inputs"]):
        shared = f"{one['in_common']:,} of them known before" if i else ""
        table.add_row(escape(Path(one["file"]).name), f"{one['landmarks']:,} landmarks", shared)
    table.add_row("together", f"{facts['landmarks']:,} landmarks", f"{facts['bytes']:,} bytes")
    console.print(table)


def check_inputs(inputs: Sequence[Path], output: Path) -> None:
    """Raise ValueError unless there are several files to join, each once, beside the output."""
    if len(inputs) < 2:
        raise ValueError("name at least two maps to join")
    seen: dict[Path, Path] = {}
    for path in inputs:
        real = path.resolve()
        if real in seen:
            raise ValueError(f"{path} is named twice: its observations would count twice")
        seen[real] = path
        if path.exists() and output.exists() and path.samefile(output):
            raise ValueError(f"{output} is one of the maps to join: name another file to write")


def open_map(path: Path) -> pm.PrototypeMap:
    """A map that takes observations.

    Raises:
        ValueError: the file holds a sealed map.
        OSError: it cannot be read.
    """
    scene = pm.open(path)
    if not isinstance(scene, pm.PrototypeMap):
        raise ValueError(f"{path} is a sealed map, which keeps no sums: give the open one")
    return scene


def _take_over(whole: pm.PrototypeMap, scene: pm.PrototypeMap) -> None:
    theirs, ours = scene.ids, whole.ids
    if len(theirs) and len(ours):
        first = int(ours[-1]) + 1
        if int(theirs[-1]) > MAX_ID - first:
            raise ValueError(
                f"landmark ids from {first} on leave no room for those up to {theirs[-1]}"
            )
        whole.update(scene, into=theirs + first, source=theirs)
    else:
        whole.update(scene)
