"""The compared methods, each under the name that `--methods`, JSON and tables use."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from protomark.evaluation.methods.bitwise import bitwise_and, majority
from protomark.evaluation.methods.medoid import medoid
from protomark.evaluation.methods.method import Method
from protomark.evaluation.methods.projection import (
    linear_discriminants,
    mean_of_bits,
    principal_components,
    projected_mean,
)
from protomark.evaluation.methods.prototypes import looks, prototypes
from protomark.evaluation.methods.single import first_seen, random_sample
from protomark.evaluation.methods.unaggregated import unaggregated
from protomark.evaluation.support import Moments, Support

if TYPE_CHECKING:
    import protomark as pm

# Codes of at least so many dimensions are compared at 4 bits a number too.
MIN_4_BIT_DIM = 16
# Bytes a landmark -> dimensions of 4 bits, for several looks. Of 16 to 64 dimensions these were the
# most precise in as many bytes on the validation sequence.
LOOKS_DIMS = {17: 24, 33: 48, 65: 64}
LOOK_BITS = 10
PROJECTED_DIMS = (8, 16, 32, 64)


@dataclass(frozen=True)
class MethodChoice:
    """A method that can be compared.

    Attributes:
        name: short name, for example "pca-16".
        label: what tables and plots say.
        family: methods that differ in nothing but size; plots join them by a line.
        build: makes the map of a support.
        default: whether it is compared when nobody names methods.
    """

    name: str
    label: str
    family: str
    build: Callable[[Support], Method]
    default: bool = True

    @property
    def is_own(self) -> bool:
        """Whether it is one of Protomark's, which take an encoder's descriptors."""
        return self.family.startswith("protomark")


def choices(
    encoders: Sequence[pm.Encoder] = (),
    discriminant_from: Moments | None = None,
    threads: int = 1,
) -> list[MethodChoice]:
    """Every method, in the order of tables.

    Args:
        encoders: those of the descriptor in question; each is compared at all its dims.
        discriminant_from: learn the linear discriminants from these moments, not from the
            support.
        threads: how many threads may build a map.
    """
    listed = [
        MethodChoice("unaggregated", "Unaggregated", "unaggregated", unaggregated),
        MethodChoice("random", "Random sample", "random", random_sample),
        MethodChoice("first", "First seen", "first", first_seen),
        MethodChoice("majority", "Quantised mean", "majority", majority),
        MethodChoice("and", "Bitwise AND", "and", bitwise_and),
        MethodChoice("medoid", "Medoid (ORB-SLAM)", "medoid", medoid),
        MethodChoice("mean", "Mean of bits, float", "mean", mean_of_bits),
    ]
    for dim in PROJECTED_DIMS:
        listed.append(
            MethodChoice(f"pca-{dim}", f"PCA mean, {dim}", "pca", _components(dim, rounded=True))
        )
    for dim in PROJECTED_DIMS:
        listed.append(
            MethodChoice(
                f"discriminant-{dim}",
                f"Discriminant, {dim}",
                "discriminant",
                _discriminants(dim, discriminant_from, rounded=True),
            )
        )
    for dim in PROJECTED_DIMS:
        listed.append(
            MethodChoice(
                f"pca-{dim}-float",
                f"PCA mean, {dim}, float",
                "pca-float",
                _components(dim, rounded=False),
                default=False,
            )
        )
        listed.append(
            MethodChoice(
                f"discriminant-{dim}-float",
                f"Discriminant, {dim}, float",
                "discriminant-float",
                _discriminants(dim, discriminant_from, rounded=False),
                default=False,
            )
        )
    for encoder in encoders:
        mark = f" ({encoder.name})" if len(encoders) > 1 else ""
        tail = f"@{encoder.name}" if len(encoders) > 1 else ""
        for dim in sorted(encoder.dims):
            listed.append(
                MethodChoice(
                    f"protomark-{dim}{tail}",
                    f"Protomark, {dim}{mark}",
                    f"protomark{tail}",
                    _prototypes(encoder, dim, threads),
                )
            )
        for dim in sorted(encoder.dims):
            if dim < MIN_4_BIT_DIM:
                continue
            listed.append(
                MethodChoice(
                    f"protomark-{dim}x4{tail}",
                    f"Protomark, {dim} x 4 bits{mark}",
                    f"protomark-4bit{tail}",
                    _prototypes(encoder, dim, threads, bits=4),
                )
            )
        for size, dim in LOOKS_DIMS.items():
            if dim not in encoder.dims:
                continue
            listed.append(
                MethodChoice(
                    f"looks-{size}{tail}",
                    f"Looks, {dim} x 4 bits{mark}",
                    f"protomark-looks{tail}",
                    _looks(encoder, dim, size, threads),
                )
            )
    return listed


def choose(listed: Sequence[MethodChoice], names: Sequence[str] | None) -> list[MethodChoice]:
    """The methods of these names, or the default ones; "pca" stands for every "pca-...".

    Raises:
        ValueError: there is no method of some name; the message lists those there are.
    """
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
    wanted = {choice.name for found in chosen.values() for choice in found}
    return [choice for choice in listed if choice.name in wanted]


def _components(dim: int, *, rounded: bool) -> Callable[[Support], Method]:
    def build(support: Support) -> Method:
        projection = principal_components(support.moments).truncated(dim)
        return projected_mean(support, projection, rounded=rounded)

    return build


def _discriminants(
    dim: int, moments: Moments | None, *, rounded: bool
) -> Callable[[Support], Method]:
    def build(support: Support) -> Method:
        projection = linear_discriminants(moments or support.moments).truncated(dim)
        return projected_mean(support, projection, rounded=rounded)

    return build


def _prototypes(
    encoder: pm.Encoder, dim: int, threads: int, bits: int = 8
) -> Callable[[Support], Method]:
    def build(support: Support) -> Method:
        return prototypes(support, encoder, dim, threads, bits)

    return build


def _looks(encoder: pm.Encoder, dim: int, size: int, threads: int) -> Callable[[Support], Method]:
    def build(support: Support) -> Method:
        return looks(support, encoder, dim, LOOK_BITS, size, threads)

    return build
