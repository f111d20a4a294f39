"""Builds a map from tracks."""

from __future__ import annotations

import numpy as np

from protomark import Encoder, PrototypeMap
from protomark.features.descriptors import InputKind
from protomark.features.upright import SUFFIX
from protomark.tracks.file import Tracks

# Prototypes of more numbers leave room for fewer appearances in as many bytes; 5 signs tell
# appearances apart almost as well as 10 and take half the memory (docs/sealing.md).
DIM = 48
APPEARANCE_BITS = 5


def chosen_dim(encoder: Encoder, dim: int | None = None) -> int:
    """Dimensions of a prototype; None: `DIM`, or what comes nearest.

    Raises:
        ValueError: the encoder has no codes of so many.
    """
    if dim is None:
        return max((d for d in encoder.dims if d <= DIM), default=min(encoder.dims))
    if dim not in encoder.dims:
        raise ValueError(
            f"--dim {dim}: encoder '{encoder.name}' has codes of "
            f"{', '.join(map(str, encoder.dims))} dimensions"
        )
    return dim


def build_map(
    tracks: Tracks,
    encoder: Encoder,
    dim: int | None = None,
    *,
    min_observations: int = 2,
    appearance_bits: int | None = None,
    threads: int = 1,
) -> PrototypeMap:
    """Build a learning map with the prototypes and the position of every landmark of `tracks`.

    Args:
        tracks: the observations.
        encoder: an encoder for their descriptor, or for its upright form.
        dim: numbers per prototype, one of `encoder.dims`; None: `chosen_dim`.
        min_observations: landmarks with fewer observations are left out.
        appearance_bits: number of signs of a code that tell the appearances of a landmark apart;
            0: each landmark has one prototype; None: `APPEARANCE_BITS`.
        threads: threads to encode on.

    Raises:
        ValueError: the encoder is for another descriptor, no landmark is left, or `dim` or
            `appearance_bits` do not fit the encoder.
    """
    tracks = tracks_for(encoder, tracks)
    rows = tracks.observations
    landmarks = tracks.landmark_of_keypoint[rows]
    ids, inverse, counts = np.unique(landmarks, return_inverse=True, return_counts=True)
    keep = counts[inverse] >= min_observations
    if not keep.any():
        raise ValueError(
            f"no landmark has {min_observations} observations: give longer tracks or lower "
            "min_observations"
        )
    dim = chosen_dim(encoder, dim)
    if appearance_bits is None:
        appearance_bits = chosen_appearance_bits(dim)
    scene = PrototypeMap(encoder, dim, appearance_bits)
    scene.add(landmarks[keep], tracks.descriptors[rows[keep]], threads=threads)
    ids = ids[counts >= min_observations]
    scene.set_positions(ids, tracks.positions_of(ids))
    return scene


def tracks_for(encoder: Encoder, tracks: Tracks) -> Tracks:
    """The tracks with the descriptors that an encoder takes, plain or upright.

    Raises:
        ValueError: the encoder is for another descriptor.
    """
    if encoder.descriptor == tracks.descriptor + SUFFIX:
        tracks = tracks.upright()
    check_encoder(encoder, tracks.descriptor, tracks.input, tracks.bits)
    return tracks


def check_encoder(encoder: Encoder, descriptor: str, kind: InputKind, bits: int) -> None:
    """Raise ValueError if an encoder is for other descriptors."""
    if (encoder.descriptor, encoder.input, encoder.bits) != (descriptor, kind, bits):
        raise ValueError(
            f"encoder '{encoder.name}' is for {encoder.descriptor} of {encoder.bytes} bytes "
            f"({encoder.input}), the tracks hold {descriptor} of {bits // 8} ({kind}): choose an "
            f"encoder for {descriptor}"
        )


def chosen_appearance_bits(dim: int) -> int:
    """`APPEARANCE_BITS`, or as many as there are numbers."""
    return min(APPEARANCE_BITS, dim)
