"""Describes the content of a file: a map, an encoder or tracks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import protomark as pm
from protomark.maps.open import map_path
from protomark.maps.shards import Manifest, is_sharded
from protomark.tracks.file import Tracks
from protomark.tracks.summary import summarise


def is_tracks(path: Path) -> bool:
    """Whether a file is a tracks file, by its suffix."""
    return path.suffix == ".safetensors"


def describe(path: Path) -> dict[str, Any]:
    """Facts about a file, or the map in a folder, as JSON; `kind` tells what it is.

    Raises:
        OSError, ValueError: the file cannot be read, or it is not one of Protomark's.
    """
    if is_tracks(path):
        return _describe_tracks(path)
    if is_sharded(path):
        return describe_shards(path, Manifest.load(path))
    path = map_path(path)
    kinds = dict(pm.file_sections(path))
    if "network" in kinds:
        return _describe_encoder(path)
    return _describe_map(path, kinds)


def describe_shards(path: Path | str, manifest: Manifest) -> dict[str, Any]:
    """Facts about a folder of shards, by its manifest."""
    shards = manifest.shards
    counts = [shard.observations for shard in shards]
    return {
        "kind": "map in shards",
        "folder": str(path),
        "landmarks": sum(shard.landmarks for shard in shards),
        "prototypes": sum(shard.prototypes for shard in shards),
        "observations": None if None in counts else sum(count or 0 for count in counts),
        "landmarks_with_position": sum(shard.placed for shard in shards),
        "dim": manifest.dim,
        "shards": len(shards),
        "largest_shard": max(shard.answering.bytes for shard in shards),
        "bytes": sum(file.bytes for shard in shards for file in shard.files),
        "metadata": dict(manifest.metadata),
        "encoder": dict(manifest.encoder),
    }


def _describe_tracks(path: Path) -> dict[str, Any]:
    tracks = Tracks.load(path)
    return {
        "kind": "tracks",
        **summarise(tracks),
        "cameras": [camera.as_dict() for camera in tracks.cameras.values()],
        "info": tracks.info,
        "bytes": path.stat().st_size,
    }


def _encoder_facts(encoder: pm.Encoder) -> dict[str, Any]:
    return {
        "name": encoder.name,
        "descriptor": encoder.descriptor,
        "input": encoder.input,
        "bits": encoder.bits,
        "dims": encoder.dims,
        "word_widths": [codebook.shape[2] for codebook in encoder.codebooks],
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
    """Bytes per landmark for prototypes, without ids.

    A learning map counts int8 prototypes, and a byte for the number of observations, by which it
    learns. The padding of a prototype to a multiple of 4 bytes counts; the up to 15 rows that pad
    the whole section do not, as they do not grow with the map.
    """
    if isinstance(scene, pm.SealedMap):
        return scene.bytes_per_landmark
    prototype = 4 * -(-scene.dim // 4)
    if scene.prototype_count == len(scene):
        return prototype + 1
    # One more byte says how many prototypes a landmark has.
    return prototype * scene.prototype_count / len(scene) + 2


def _index_bytes(scene: pm.PrototypeMap | pm.SealedMap, sections: dict[str, int]) -> float | None:
    """Bytes per landmark of a sealed map's index, including the rows that pad its blocks."""
    if not isinstance(scene, pm.SealedMap) or scene.nlist == 0:
        return None
    blocks = -(-scene.prototype_count // 16)
    packed = blocks * 16 * (scene.words or 4 * -(-scene.dim // 4))
    sections_bytes = sum(
        sections.get(name, 0) for name in ("centroid", "listrows", "owners", "ownercrc", "recall")
    )
    return (sections_bytes + sections["protos"] - packed) / max(1, len(scene))


def _describe_map(path: Path, sections: dict[str, int]) -> dict[str, Any]:
    scene = pm.open(path)
    summary = scene.summary()
    counts = summary.get("count_histogram")
    sealed = scene if isinstance(scene, pm.SealedMap) else None
    landmarks = max(1, len(scene))
    ids = sum(sections.get(name, 0) for name in ("idblocks", "idgaps")) / landmarks
    error = None if sealed is None else sealed.position_error
    appearance_bits = scene.appearance_bits if isinstance(scene, pm.PrototypeMap) else 0
    several = appearance_bits > 0 or scene.prototype_count != len(scene)
    return {
        "kind": "learning map" if sealed is None else "sealed map",
        "landmarks": len(scene),
        "prototypes": scene.prototype_count if several else None,
        "prototypes_per_landmark": scene.prototype_count / landmarks if several else None,
        "appearance_bits": appearance_bits or None,
        "dim": scene.dim,
        "words": None if sealed is None else sealed.words or None,
        "nlist": scene.nlist or None,
        "index_bytes_per_landmark": _index_bytes(scene, sections),
        "observations": summary.get("observations"),
        "count_histogram": None if counts is None else np.trim_zeros(counts, "b").tolist(),
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
