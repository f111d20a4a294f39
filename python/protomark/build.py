"""A map from tracks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from protomark import Encoder, PrototypeMap
from protomark.inputs import lacking, lengthen, option
from protomark.tracks import Tracks


def build_map(
    tracks: Tracks,
    encoder: Encoder,
    dim: int | None = None,
    min_observations: int = 2,
    threads: int = 1,
    look_bits: int = 0,
) -> PrototypeMap:
    """An open map with the prototypes and position of every landmark of `tracks`.

    Args:
        tracks: the observations.
        encoder: an encoder for their descriptor.
        dim: dimensions of a prototype, one of `encoder.dims`; None: all.
        min_observations: landmarks with fewer are left out.
        threads: threads to encode on.
        look_bits: signs of a code that tell the looks of a landmark apart; 0: it has one prototype.

    Raises:
        ValueError: the encoder is for another descriptor, no landmark is left, or dim or look_bits
            does not fit the encoder.
    """
    check_descriptor(tracks, encoder)
    rows = tracks.observations
    landmarks = tracks.landmark_of_keypoint[rows]
    known, inverse, counts = np.unique(landmarks, return_inverse=True, return_counts=True)
    keep = counts[inverse] >= min_observations
    if not keep.any():
        raise ValueError(
            f"no landmark has {min_observations} observations: there is no map to build"
        )
    scene = PrototypeMap(encoder, dim, look_bits)
    scene.add(landmarks[keep], tracks.descriptors[rows[keep]], threads=threads)
    ids = known[counts >= min_observations]
    scene.set_positions(ids, tracks.landmark_positions[np.searchsorted(tracks.landmark_ids, ids)])
    return scene


def check_descriptor(tracks: Tracks, encoder: Encoder) -> None:
    """Raise ValueError unless the encoder takes the descriptors of the tracks."""
    if encoder.descriptor != tracks.descriptor or encoder.bits != tracks.bits:
        longer = lacking(tracks.descriptor, encoder.descriptor)
        raise ValueError(
            f"encoder '{encoder.name}' is for {encoder.descriptor} with {encoder.bits} bits, the "
            f"tracks hold {tracks.descriptor} with {tracks.bits}: choose an encoder for "
            f"{tracks.descriptor}{f', or build with {option(longer)}' if longer else ''}"
        )


def build_file(
    tracks: Path,
    output: Path,
    encoder: str | None,
    dim: int | None,
    min_observations: int,
    seal: bool,
    threads: int,
    code_bits: int = 8,
    inputs: str = "",
    look_bits: int = 0,
    prototypes: float | None = None,
    index: bool = False,
    metadata: Mapping[str, str] | None = None,
    position_bits: int = 32,
) -> PrototypeMap:
    """Build the map of a tracks file and write it; `encoder` None: the one of that descriptor.

    With `inputs` angles or sizes of the keypoints go in, too (`protomark.inputs`); with `index` the
    map can be searched approximately. `metadata` is what the map shall say of itself.

    Raises:
        ValueError: as `build_map`; or `code_bits`, those of a sealed map, is neither 8 nor 4, or is
            4 where none is sealed; or `prototypes`, a sealed map's largest mean number of them a
            landmark, is below 1, or given where no map is sealed or landmarks have no looks; or
            `position_bits`, of a sealed map's coordinates, is neither 32 nor 16, or is 16 where
            none is sealed.
    """
    if position_bits not in (32, 16):
        raise ValueError(f"--position-bits {position_bits}: a sealed map has 32 or 16")
    if position_bits != 32 and not seal:
        raise ValueError(f"--position-bits {position_bits} is for sealed maps: add --sealed")
    if code_bits not in (8, 4):
        raise ValueError(f"--code-bits {code_bits}: a sealed map has 8 or 4 bits a number")
    if code_bits != 8 and not seal:
        raise ValueError(f"--code-bits {code_bits} is for sealed maps: add --sealed")
    if prototypes is not None:
        if not prototypes >= 1:
            raise ValueError(f"--prototypes {prototypes:g}: a landmark has at least 1")
        if not seal:
            raise ValueError(f"--prototypes {prototypes:g} is for sealed maps: add --sealed")
        if look_bits == 0:
            raise ValueError(
                f"--prototypes {prototypes:g} is for landmarks with looks: add --look-bits 10"
            )
    loaded = lengthen(Tracks.load(tracks), inputs)
    scene = build_map(
        loaded,
        Encoder.load(encoder or loaded.descriptor),
        dim,
        min_observations,
        threads,
        look_bits,
    )
    scene.metadata = metadata or {}
    if index:
        scene.build_index(threads=threads, in_place=True)  # nobody searches yet
    if seal:
        scene.seal(output, bits=code_bits, prototypes=prototypes, position_bits=position_bits)
    else:
        scene.save(output)
    return scene
