"""What a file holds, at a glance: a map, an encoder or tracks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import protomark as pm
from protomark.tracks import Tracks

_BARS = "▁▂▃▄▅▆▇█"


def is_tracks(path: Path) -> bool:
    """Whether `describe` reads a file as tracks, which its name says."""
    return path.suffix == ".safetensors"


def describe(path: Path) -> dict[str, Any]:
    """Facts about a file as JSON values; `kind` says what it is.

    Raises:
        OSError, ValueError: the file cannot be read, or is none of Protomark's.
    """
    if is_tracks(path):
        return _describe_tracks(path)
    kinds = dict(pm.file_sections(path))
    if "network" in kinds:
        return _describe_encoder(path)
    return _describe_map(path, kinds)


def _describe_tracks(path: Path) -> dict[str, Any]:
    tracks = Tracks.load(path)
    observations = len(tracks.observations)
    return {
        "kind": "tracks",
        "descriptor": tracks.descriptor,
        "bits": tracks.bits,
        "keyframes": len(tracks.keyframe_names),
        "keypoints": len(tracks.keypoints),
        "landmarks": len(tracks.landmark_ids),
        "observations": observations,
        "observations_per_landmark": observations / max(1, len(tracks.landmark_ids)),
        "cameras": [camera.as_dict() for camera in tracks.cameras.values()],
        "info": tracks.info,
        "bytes": path.stat().st_size,
    }


def _encoder_facts(encoder: pm.Encoder) -> dict[str, Any]:
    return {
        "name": encoder.name,
        "descriptor": encoder.descriptor,
        "bits": encoder.bits,
        "dims": encoder.dims,
        "multiply_adds": encoder.multiply_adds,
        "identity": encoder.identity,
        "data": encoder.data,
        "licence": encoder.licence,
        "notes": dict(encoder.notes),
    }


def _describe_encoder(path: Path) -> dict[str, Any]:
    encoder = pm.Encoder.load(path)
    return {"kind": "encoder", **_encoder_facts(encoder), "bytes": path.stat().st_size}


def matching_bytes(scene: pm.PrototypeMap | pm.SealedMap) -> float:
    """Bytes a landmark that matching needs of a sealed map: prototypes and count, ids left out.

    An open map counts as if it were sealed as it is, with 8 bits a number. The numbers that pad
    a prototype to a whole 4 bytes are counted; the up to 15 rows that pad the whole section
    (`docs/format.md`) are not, as they do not grow with the map.
    """
    bits = scene.code_bits if isinstance(scene, pm.SealedMap) else 8
    in_a_word = 32 // bits
    prototype = 4 * -(-scene.dim // in_a_word)
    if scene.prototype_count == len(scene):
        return prototype + 1
    # One more byte says how many prototypes a landmark has.
    return prototype * scene.prototype_count / len(scene) + 2


def _index_bytes(scene: pm.PrototypeMap | pm.SealedMap, sections: dict[str, int]) -> float | None:
    """Bytes a landmark that the index of a sealed map takes, blocks that are not full included."""
    if not isinstance(scene, pm.SealedMap) or scene.index_cells == 0:
        return None
    width = {8: 4, 4: 8}[scene.code_bits]  # dimensions in 4 bytes
    blocks = -(-scene.prototype_count // 16)
    packed = blocks * 16 * -(-scene.dim // width) * 4
    own = sum(
        sections.get(name, 0) for name in ("cells", "cellrows", "order", "ordersum", "probes")
    )
    return (own + sections["protos"] - packed) / max(1, len(scene))


def _describe_map(path: Path, sections: dict[str, int]) -> dict[str, Any]:
    scene = pm.open(path)
    summary = scene.summary()
    sealed = scene if isinstance(scene, pm.SealedMap) else None
    landmarks = max(1, len(scene))
    ids = sum(sections.get(name, 0) for name in ("ids", "idblocks", "idrests")) / landmarks
    error = None if sealed is None else sealed.position_error
    look_bits = scene.look_bits if isinstance(scene, pm.PrototypeMap) else 0
    looks = look_bits > 0 or scene.prototype_count != len(scene)
    return {
        "kind": "open map" if sealed is None else "sealed map",
        "landmarks": len(scene),
        "prototypes": scene.prototype_count if looks else None,
        "prototypes_per_landmark": scene.prototype_count / landmarks if looks else None,
        "look_bits": look_bits or None,
        "dim": scene.dim,
        "code_bits": None if sealed is None else sealed.code_bits,
        "index_cells": scene.index_cells or None,
        "index_bytes_per_landmark": _index_bytes(scene, sections),
        "observations": summary["observations"],
        "count_histogram": np.trim_zeros(summary["count_histogram"], "b").tolist(),
        "landmarks_with_position": summary["landmarks_with_position"],
        "position_bits": None if sealed is None else sealed.position_bits or None,
        "position_error": None if error is None else error.tolist(),
        "extent": None if summary["extent"] is None else summary["extent"].tolist(),
        "metadata": dict(scene.metadata),
        "bytes_per_landmark_for_matching": None if sealed is None else matching_bytes(scene) + ids,
        "bytes": path.stat().st_size,
        "bytes_by_section": sections,
        "bytes_per_landmark_by_section": {
            name: size / landmarks for name, size in sections.items()
        },
        "journal": pm.file_journal(path),
        "encoder": _encoder_facts(scene.encoder),
    }


def _bars(histogram: list[int]) -> str:
    """A histogram of counts 1, 2, ... as one line of bars, the tail folded into the last."""
    shown = [*histogram[1:16], sum(histogram[16:])]
    top = max(max(shown), 1)
    return "".join(_BARS[int(v / top * (len(_BARS) - 1))] if v else " " for v in shown)


def show(facts: dict[str, Any]) -> None:
    """Print what `describe` returned."""
    from rich.markup import escape
    from rich.table import Table

    from protomark.console import console

    table = Table.grid(padding=(0, 2))
    table.add_column()
    table.add_column(overflow="fold")
    for key, value in facts.items():
        if value is None:
            continue
        name = key.replace("_", " ")
        if key == "count_histogram":
            table.add_row("observations a landmark", f"1 {_bars(value)} 16 and more")
        elif key == "extent":
            table.add_row(name, " to ".join(_vector(corner) for corner in value))
        elif key == "position_error":
            table.add_row(name, _vector(value))
        elif key == "bytes_by_section":
            for section, size in value.items():
                landmark = facts["bytes_per_landmark_by_section"][section]
                table.add_row(
                    escape(_text(f"bytes: {section}")), f"{size:,}  {landmark:,.2f} a landmark"
                )
        elif key == "bytes_per_landmark_by_section":
            continue
        elif isinstance(value, dict):
            for label, text in _rows(name, value):
                table.add_row(escape(label), escape(text))
        else:
            table.add_row(name, escape(_text(value)))
    console.print(table)


def _rows(name: str, values: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """A line for each value, under its own name and that of what it belongs to."""
    for key, value in values.items():
        label = f"{name}: {key.replace('_', ' ')}"
        if key == "notes" and isinstance(value, dict):
            for note, text in value.items():
                yield _text(f"{label}: {note.replace('_', ' ')}"), _text(text)
        else:
            yield _text(label), _text(value)


def _vector(values: list[float]) -> str:
    return f"({', '.join(f'{v:,.6g}' for v in values)})"


def _text(value: Any) -> str:
    if isinstance(value, str) and not value.isprintable():
        # A file from a stranger shall not speak to the terminal.
        return "".join(c if c.isprintable() else repr(c)[1:-1] for c in value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return str(value)
    return f"{value:,}" if isinstance(value, int) else f"{value:,.2f}"
