"""How a map is made: everything that decides its content."""

from __future__ import annotations

from dataclasses import dataclass

from protomark.mapping.memory import MEMORIES
from protomark.tracks.features import descriptor_kind


@dataclass(frozen=True)
class Settings:
    """How a map is made. docs/mapping.md says what each default was chosen by.

    Attributes:
        descriptor: name of the descriptor, see `protomark.tracks.features.DESCRIPTORS`.
        max_keypoints: keypoints kept in a frame.
        memory: what the map keeps of descriptors: prototypes, medoids or descriptors (all of them).
        encoder: name or file of the encoder; empty: the descriptor's own.
        dim: dimensions of a prototype.
        window: last keyframes that keep their descriptors, to triangulate new landmarks.
        max_error: largest reprojection error of an observation, as a share of the longer side.
        min_angle: smallest angle between two rays of a landmark, degrees.
        min_inliers: fewest matches that must agree with a frame's pose.
        calibrate: whether focal length and distortion are refined along the way.
        fixed_poses: whether poses are given and stay as they are.
    """

    descriptor: str = "akaze"
    max_keypoints: int = 2000
    memory: str = "prototypes"
    encoder: str = ""
    dim: int = 32
    window: int = 8
    max_error: float = 0.005
    min_angle: float = 1.0
    min_inliers: int = 20
    calibrate: bool = False
    fixed_poses: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "descriptor", descriptor_kind(self.descriptor).name)
        checks = (
            ("max_keypoints", self.max_keypoints >= 50, "at least 50"),
            ("memory", self.memory in MEMORIES, f"one of {', '.join(MEMORIES)}"),
            ("window", self.window >= 2, "at least 2"),
            ("max_error", 0 < self.max_error <= 0.05, "in (0, 0.05]"),
            ("min_angle", 0 < self.min_angle < 45, "in (0, 45)"),
            ("min_inliers", self.min_inliers >= 8, "at least 8"),
        )
        for name, fine, want in checks:
            if not fine:
                raise ValueError(f"{name} is {getattr(self, name)}, it must be {want}")
