"""The compared methods, with their names in `--methods`, JSON and tables."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

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
from protomark.baselines.clusters import mean_shift
from protomark.baselines.hashing import iterative_quantization, random_hyperplanes
from protomark.baselines.linear import (
    linear_discriminants,
    principal_components,
    projected_mean,
    real_mean,
)
from protomark.baselines.method import Method
from protomark.baselines.quantization import RABITQ_FACTORS, product_quantized_mean, rabitq
from protomark.baselines.support import Moments, Support
from protomark.features.descriptors import InputKind
from protomark.features.upright import SUFFIX
from protomark.maps.info import matching_bytes

# Bytes per landmark of the sealed maps that are compared.
SEALED_BYTES = (9, 17, 25, 33, 65)
# Signs that tell appearances apart in the learning maps that are sealed, as `protomark map` has.
APPEARANCE_BITS = 5
PROJECTED_DIMS = (8, 16, 32, 64)
MAPLAB_DIM = 10  # discriminants that maplab keeps, as floats
# Bytes of codes of the mean, and those that are compared by default: one that takes little time.
CODE_BYTES = (4, 8, 16, 32, 64)
DEFAULT_CODE_BYTES = 32


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
    """A learning map of prototypes, with a byte for each landmark's count, or a sealed one."""

    def __init__(self, scene: pm.PrototypeMap | pm.SealedMap) -> None:
        self.map = scene
        # A learning map searches the int8 prototypes that a sealed one would have.
        self.bytes_per_landmark = matching_bytes(scene)

    def match(
        self, descriptors: NDArray[Any], threads: int = 1
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """See `Method.match`."""
        ids, squared = self.map.search(descriptors, k=2, threads=threads)
        return ids, np.where(ids >= 0, np.sqrt(squared.astype(np.float32)), np.float32(np.inf))


def prototype_map(
    support: Support,
    encoder: pm.Encoder,
    dim: int | None = None,
    bytes_per_landmark: float | None = None,
    tuned_by: Literal["observations", "appearances", "nothing"] = "observations",
    threads: int = 1,
) -> PrototypeMethod:
    """Protomark itself: means of an encoder's codes (Komorowski and Trzcinski, Eq. 1).

    The learning map of `dim` int8 numbers per landmark, or a map sealed to `bytes_per_landmark`.
    """
    bits = 0 if bytes_per_landmark is None else min(APPEARANCE_BITS, encoder.dim)
    scene = pm.PrototypeMap(encoder, dim, bits)
    scene.add(support.landmarks, support.descriptors, threads=threads)
    if bytes_per_landmark is None:
        return PrototypeMethod(scene)
    observed = tuned_by == "observations"
    with tempfile.TemporaryDirectory(prefix="protomark-") as folder:
        sealed = scene.seal(
            # A mapped file stays readable after it is deleted.
            Path(folder) / "scene.sealed.pmk",
            support.landmarks if observed else None,
            support.descriptors if observed else None,
            bytes_per_landmark=bytes_per_landmark,
            tune=tuned_by != "nothing",
            threads=threads,
        )
    return PrototypeMethod(sealed)


def method_choices(
    # Encoders for the descriptor, each of which is compared at all its dims.
    encoders: Sequence[pm.Encoder] = (),
    # Moments to learn linear discriminants from; None: those of the support.
    discriminant_from: Moments | None = None,
    threads: int = 1,
    width: int = 512,  # how many numbers descriptors have: bits, or those of vectors
    kind: InputKind = "bits",  # what the descriptors are
) -> list[MethodChoice]:
    """Every method for these descriptors, in the order of tables."""
    listed = [
        MethodChoice("unaggregated", "Unaggregated", "unaggregated", unaggregated),
        MethodChoice("random", "Random sample", "random", random_sample),
        MethodChoice("first", "First seen", "first", first_seen),
        MethodChoice("majority", "Quantised mean", "majority", majority),
        MethodChoice("and", "Bitwise AND", "and", bitwise_and),
        MethodChoice("medoid", "Medoid (ORB-SLAM)", "medoid", medoid),
        MethodChoice("clusters", "Mean-shift clusters", "clusters", mean_shift),
        MethodChoice("mean", "Mean, float", "mean", real_mean),
    ]
    other = "clusters" if kind == "bits" else "and"
    listed = [choice for choice in listed if choice.name != other]
    for rounded in (True, False):
        for family, label in (("pca", "PCA mean"), ("discriminant", "Discriminant")):
            kept = () if rounded or family == "pca" else (MAPLAB_DIM,)
            for dim in (*PROJECTED_DIMS, *kept):
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
    for family, label, build_code in (
        ("pq", "Product quantiser", product_quantized_mean),
        ("itq", "Iterative quantisation", iterative_quantization),
        ("lsh", "Random hyperplanes", random_hyperplanes),
    ):
        listed += [
            MethodChoice(
                f"{family}-{size}",
                f"{label}, {size} B",
                family,
                partial(build_code, size=size),
                default=size == DEFAULT_CODE_BYTES,
            )
            for size in CODE_BYTES
            # There are no more components than numbers, nor more words.
            if family == "lsh" or size * (8 if family == "itq" else 1) <= width
        ]
    listed += [
        MethodChoice(
            f"rabitq{depth}-{size}",
            f"RaBitQ, {depth} b, {size} B",
            f"rabitq{depth}",
            partial(rabitq, size=size, depth=depth),
            default=False,
        )
        for depth in (1, 2, 3, 4)
        for size in CODE_BYTES[2:]  # fewer have no room beside its two floats
        # There are no more components than numbers.
        if 8 * (size - RABITQ_FACTORS) <= depth * width
    ]
    for encoder in encoders:
        listed += _prototype_choices(encoder, len(encoders) > 1, threads)
    return listed


def _prototype_choices(encoder: pm.Encoder, named: bool, threads: int) -> list[MethodChoice]:
    mark = f" ({encoder.name})" if named else ""
    tail = f"@{encoder.name}" if named else ""
    upright = encoder.descriptor.endswith(SUFFIX)

    def choice(name: str, label: str, family: str, default: bool, **wanted: Any) -> MethodChoice:
        def build(support: Support) -> Method:
            return prototype_map(support, encoder, threads=threads, **wanted)

        return MethodChoice(name + tail, label + mark, family + tail, build, default, upright)

    listed = [
        choice(f"protomark-{d}", f"Protomark, {d}", "protomark", True, dim=d)
        for d in sorted(encoder.dims)
    ]
    smallest = min(
        (d // book.shape[2] + 1 for d in encoder.dims for book in encoder.codebooks), default=None
    )
    for family, label, tuned_by in (
        ("sealed", "Sealed", "observations"),
        ("appearances", "Sealed, tuned by appearances", "appearances"),
        ("untuned", "Sealed, untuned", "nothing"),
    ):
        listed += [
            choice(
                f"{family}-{size}",
                f"{label}, {size} B",
                f"protomark-{family}",
                family == "sealed",
                bytes_per_landmark=size,
                tuned_by=tuned_by,
            )
            for size in SEALED_BYTES
            if smallest is not None and smallest <= size
        ]
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
                f"there is no method {name!r} for these descriptors: choose from "
                + ", ".join(choice.name for choice in listed)
            )
    names_chosen = {choice.name for found in chosen.values() for choice in found}
    return [choice for choice in listed if choice.name in names_chosen]
