"""Records what became of each frame, and the size of the map after it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from protomark.mapping.clock import STAGES

REGISTERED = "registered"


@dataclass
class FrameRecord:
    """What became of one frame of the input.

    Attributes:
        index: index in its input.
        name: image name.
        outcome: "registered", or why it is not.
        keypoints: number of keypoints.
        inliers: matches that agree with its pose, 0 without one.
        keyframe: whether it is a keyframe.
        landmarks: landmarks of the map after this frame.
        observations: observations of the map after this frame.
        memory_bytes: bytes that matching needs after this frame.
        descriptor_bytes: bytes that all descriptors of these observations would take.
        window_bytes: bytes of the descriptors in the window.
        seconds: seconds by stage.
    """

    index: int
    name: str
    outcome: str
    keypoints: int = 0
    inliers: int = 0
    keyframe: bool = False
    landmarks: int = 0
    observations: int = 0
    memory_bytes: int = 0
    descriptor_bytes: int = 0
    window_bytes: int = 0
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass
class History:
    """Records of all frames in the order of the input, and events.

    Attributes:
        records: records by frame name.
        events: sentences such as "frame 31: a place seen before, 45 landmarks merged".
        closing_seconds: seconds by stage before the first frame and before a restart, and after
            the last frame (retries, global adjustment).
    """

    records: dict[str, FrameRecord] = field(default_factory=dict)
    events: list[str] = field(default_factory=list)
    closing_seconds: dict[str, float] = field(default_factory=dict)

    def total_seconds(self) -> dict[str, float]:
        """Seconds by stage over all frames and after them."""
        total: dict[str, float] = dict.fromkeys(STAGES, 0.0)
        for parts in (*(r.seconds for r in self.records.values()), self.closing_seconds):
            for name, value in parts.items():
                total[name] += value
        return total

    def as_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "records": [vars(record) for record in self.records.values()],
            "events": self.events,
            "closing_seconds": self.closing_seconds,
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> History:
        """The history that `as_dict` returned."""
        records = [FrameRecord(**record) for record in values["records"]]
        by_name = {record.name: record for record in records}
        return cls(by_name, list(values["events"]), dict(values["closing_seconds"]))
