"""Options that determine the content of a map."""

from __future__ import annotations

from dataclasses import dataclass

from protomark.features.descriptors import InputKind, descriptor_kind
from protomark.features.extractor import MAX_SIZE, Extractor
from protomark.maps.build import APPEARANCE_BITS, DIM


@dataclass(frozen=True)
class MappingOptions:
    """How a map is made."""

    # Name of the descriptor, see `protomark.features.descriptors.DESCRIPTORS`.
    descriptor: str = "akaze"
    max_keypoints: int = 2000  # limit on keypoints per frame
    max_size: int = MAX_SIZE  # frames with a longer side are reduced to it before detection
    encoder: str = ""  # name or file of the encoder; empty: the one that ships for the descriptor
    dim: int = DIM  # numbers per prototype
    # Number of signs of a code that tell the appearances of a landmark apart.
    appearance_bits: int = APPEARANCE_BITS
    # Number of latest keyframes that keep their descriptors, to triangulate landmarks.
    window: int = 8
    # Largest reprojection error of an observation, as a share of the longer side.
    max_error: float = 0.005
    min_angle: float = 1.0  # smallest triangulation angle of a landmark, degrees
    min_inliers: int = 20  # number of matches that must agree with a frame's pose
    calibrate: bool = False  # whether focal length and distortion are refined while mapping
    fixed_poses: bool = False  # whether poses are given and not adjusted

    @property
    def kind(self) -> InputKind:
        """What the descriptor is of."""
        return descriptor_kind(self.descriptor).input

    def extractor(self) -> Extractor:
        """What detects and describes the keypoints of frames."""
        return Extractor(self.descriptor, self.max_keypoints, self.max_size)

    def __post_init__(self) -> None:
        object.__setattr__(self, "descriptor", descriptor_kind(self.descriptor).name)
        checks = (
            ("max_keypoints", self.max_keypoints >= 50, "at least 50"),
            ("window", self.window >= 2, "at least 2"),
            ("max_error", 0 < self.max_error <= 0.05, "in (0, 0.05]"),
            ("min_angle", 0 < self.min_angle < 45, "in (0, 45)"),
            ("min_inliers", self.min_inliers >= 8, "at least 8"),
        )
        for name, valid, expected in checks:
            if not valid:
                told = f"--{name.replace('_', '-')} {getattr(self, name)}"
                raise ValueError(f"{told}: it must be {expected}")
