"""The compared methods, with their names in `--methods`, JSON and tables."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.baselines.binary import (
    bitwise_and,
    first_seen,
    majority,
    medoid,
    random_sample,
    unaggregated,
)
from protomark.baselines.linear import (
    linear_discriminants,
    mean_of_bits,
    principal_components,
    projected_mean,
)
from protomark.baselines.method import Method
from protomark.baselines.support import Moments, Support
from protomark.features.upright import SUFFIX
from protomark.maps.info import matching_bytes

# Codes of at least this length are compared at 4 bits per number, too.
MIN_4_BIT_DIM = 16
# Code lengths by bytes per landmark, for several appearances at 4 bits per number. Of lengths 16 to
# 64 these were the most precise on the validation sequence.
APPEARANCE_DIMS = {17: 24, 33: 48, 65: 64}
APPEARANCE_BITS = 10
PROJECTED_DIMS = (8, 16, 32, 64)


@dataclass(frozen=True)
class MethodChoice:
    """A method that can be compared."""

    name: str  # short name, such as "pca-16"
    label: str  # its name in tables and plots
    family: str  # name of methods that differ only in size, which plots connect by a line
    build: Callable[[Support], Method]  # builds the map of a support
    default: bool = True  # whether it is compared unless methods are named
    upright: bool = False  # whether it takes upright descriptors (`protomark.features.upright`)


class PrototypeMethod(Method):
    """A learning or a sealed map of prototypes.

    A prototype has k numbers of 8 or 4 bits. A landmark has one byte for the count, and one for the
    number of its prototypes if there may be several.
    """

    def __init__(self, scene: pm.PrototypeMap | pm.SealedMap) -> None:
        self.map = scene
        # A learning map searches the int8 prototypes that a sealed one would have.
        self.bytes_per_landmark = matching_bytes(scene)

    def match(
        self, descriptors: NDArray[np.uint8], threads: int = 1
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """See `Method.match`."""
        ids, squared = self.map.search(descriptors, k=2, threads=threads)
        return ids, np.where(ids >= 0, np.sqrt(squared.astype(np.float32)), np.float32(np.inf))


def prototype_map(
    support: Support,
    encoder: pm.Encoder,
    dim: int,
    bytes_per_landmark: float | None = None,
    appearance_bits: int = 0,
    threads: int = 1,
) -> PrototypeMethod:
    """Protomark itself: means of an encoder's codes (Komorowski and Trzcinski, Eq. 1).

    `bytes_per_landmark` and `appearance_bits` are those of `PrototypeMap` and its `seal`.
    """
    scene = pm.PrototypeMap(encoder, dim, appearance_bits)
    scene.add(support.landmarks, support.descriptors, threads=threads)
    if bytes_per_landmark is None:
        return PrototypeMethod(scene)
    with tempfile.TemporaryDirectory(prefix="protomark-") as folder:
        # A mapped file stays readable after it is deleted.
        path = Path(folder) / "scene.sealed.pmk"
        return PrototypeMethod(scene.seal(path, bytes_per_landmark=bytes_per_landmark))


def method_choices(
    # Encoders for the descriptor, each of which is compared at all its dims.
    encoders: Sequence[pm.Encoder] = (),
    # Moments to learn linear discriminants from; None: those of the support.
    discriminant_from: Moments | None = None,
    threads: int = 1,
) -> list[MethodChoice]:
    """Every method, in the order of tables."""
    listed = [
        MethodChoice("unaggregated", "Unaggregated", "unaggregated", unaggregated),
        MethodChoice("random", "Random sample", "random", random_sample),
        MethodChoice("first", "First seen", "first", first_seen),
        MethodChoice("majority", "Quantised mean", "majority", majority),
        MethodChoice("and", "Bitwise AND", "and", bitwise_and),
        MethodChoice("medoid", "Medoid (ORB-SLAM)", "medoid", medoid),
        MethodChoice("mean", "Mean of bits, float", "mean", mean_of_bits),
    ]
    for rounded in (True, False):
        for family, label in (("pca", "PCA mean"), ("discriminant", "Discriminant")):
            for dim in PROJECTED_DIMS:
                build = _projected(family, dim, discriminant_from, rounded)
                tail, mark = ("", "") if rounded else ("-float", ", float")
                listed.append(
                    MethodChoice(
                        f"{family}-{dim}{tail}",
                        f"{label}, {dim}{mark}",
                        family + tail,
                        build,
                        default=rounded,
                    )
                )
    for encoder in encoders:
        listed += _prototype_choices(encoder, len(encoders) > 1, threads)
    return listed


def _prototype_choices(encoder: pm.Encoder, named: bool, threads: int) -> list[MethodChoice]:
    mark = f" ({encoder.name})" if named else ""
    tail = f"@{encoder.name}" if named else ""
    upright = encoder.descriptor.endswith(SUFFIX)
    dims = sorted(encoder.dims)

    def choice(
        name: str, label: str, family: str, dim: int, size: float | None = None, bits: int = 0
    ) -> MethodChoice:
        def build(support: Support) -> Method:
            return prototype_map(support, encoder, dim, size, bits, threads)

        return MethodChoice(name + tail, label + mark, family + tail, build, upright=upright)

    listed = [choice(f"protomark-{d}", f"Protomark, {d}", "protomark", d) for d in dims]
    for d in dims:
        if d >= MIN_4_BIT_DIM:
            size = 4 * -(-d // 8) + 1
            label = f"Protomark, {d} x 4 bits"
            listed.append(choice(f"protomark-{d}x4", label, "protomark-4bit", d, size))
    for size, d in APPEARANCE_DIMS.items():
        if d in dims:
            label = f"Appearances, {d} x 4 bits"
            listed.append(
                choice(
                    f"appearances-{size}",
                    label,
                    "protomark-appearances",
                    d,
                    size,
                    APPEARANCE_BITS,
                )
            )
    return listed


def _projected(
    family: str, dim: int, moments: Moments | None, rounded: bool
) -> Callable[[Support], Method]:
    def build(support: Support) -> Method:
        if family == "pca":
            projection = principal_components(support.moments)
        else:
            projection = linear_discriminants(moments or support.moments)
        return projected_mean(support, projection.truncated(dim), rounded=rounded)

    return build


def choose_methods(
    listed: Sequence[MethodChoice], names: Sequence[str] | None
) -> list[MethodChoice]:
    """The methods of these names or families, or the default ones."""
    if not names:
        return [choice for choice in listed if choice.default]
    chosen = {
        name: [choice for choice in listed if name in (choice.name, choice.family)]
        for name in names
    }
    for name, found in chosen.items():
        if not found:
            raise ValueError(
                f"there is no method {name!r}: choose from "
                + ", ".join(choice.name for choice in listed)
            )
    names_chosen = {choice.name for found in chosen.values() for choice in found}
    return [choice for choice in listed if choice.name in names_chosen]
