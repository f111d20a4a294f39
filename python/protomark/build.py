"""A map from tracks."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from protomark import Encoder, PrototypeMap
from protomark.tracks import Tracks
from protomark.upright import upright_tracks


def build_map(
    tracks: Tracks,
    encoder: Encoder,
    dim: int | None = None,
    min_observations: int = 2,
    threads: int = 1,
) -> PrototypeMap:
    """An open map with the prototype and position of every landmark of `tracks`.

    Args:
        tracks: the observations.
        encoder: an encoder for their descriptor.
        dim: dimensions of a prototype, one of `encoder.dims`; None: all.
        min_observations: landmarks with fewer are left out.
        threads: threads to encode on.

    Raises:
        ValueError: the encoder is for another descriptor, or no landmark is left.
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
    scene = PrototypeMap(encoder, dim)
    scene.add(landmarks[keep], tracks.descriptors[rows[keep]], threads=threads)
    ids = known[counts >= min_observations]
    scene.set_positions(ids, tracks.landmark_positions[np.searchsorted(tracks.landmark_ids, ids)])
    return scene


def check_descriptor(tracks: Tracks, encoder: Encoder) -> None:
    """Raise ValueError unless the encoder takes the descriptors of the tracks."""
    if encoder.descriptor != tracks.descriptor or encoder.bits != tracks.bits:
        raise ValueError(
            f"encoder '{encoder.name}' is for {encoder.descriptor} with {encoder.bits} bits, the "
            f"tracks hold {tracks.descriptor} with {tracks.bits}: choose an encoder for "
            f"{tracks.descriptor}"
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
    upright: bool = False,
) -> PrototypeMap:
    """Build the map of a tracks file and write it; `encoder` None: the one of that descriptor.

    With `upright` angles and sizes of the keypoints go in, too (`protomark.upright`).

    Raises:
        ValueError: as `build_map`; or `code_bits`, those of a sealed map, is neither 8 nor 4, or is
            4 where none is sealed.
    """
    if code_bits not in (8, 4):
        raise ValueError(f"--code-bits {code_bits}: a sealed map has 8 or 4 bits a number")
    if code_bits != 8 and not seal:
        raise ValueError(f"--code-bits {code_bits} is for sealed maps: add --sealed")
    loaded = Tracks.load(tracks)
    if upright:
        loaded = upright_tracks(loaded)
    scene = build_map(
        loaded, Encoder.load(encoder or loaded.descriptor), dim, min_observations, threads
    )
    if seal:
        scene.seal(output, bits=code_bits)
    else:
        scene.save(output)
    return scene
