"""Records what became of each frame, and the size of the map after it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from protomark.mapping.clock import STAGES

REGISTERED = "registered"


@dataclass
class FrameRecord:
    """What became of one frame of the input."""

    index: int  # index in its input
    name: str  # image name
    outcome: str  # "registered", or why it is not
    keypoints: int = 0  # number of keypoints
    inliers: int = 0  # matches that agree with its pose, 0 without one
    keyframe: bool = False  # whether it is a keyframe
    landmarks: int = 0  # landmarks of the map after this frame
    observations: int = 0  # observations of the map after this frame
    memory_bytes: int = 0  # bytes that matching needs after this frame
    descriptor_bytes: int = 0  # bytes that all descriptors of these observations would take
    window_bytes: int = 0  # bytes of the descriptors in the window
    seconds: dict[str, float] = field(default_factory=dict)  # seconds by stage


@dataclass
class History:
    """Records of all frames in the order of the input, and events."""

    records: dict[str, FrameRecord] = field(default_factory=dict)  # records by frame name
    # Sentences such as "frame 31: a place seen before, 45 landmarks merged".
    events: list[str] = field(default_factory=list)
    # Seconds by stage before the first frame and before a restart, and after the last frame
    # (retries, global adjustment).
    closing_seconds: dict[str, float] = field(default_factory=dict)
    earlier: int = 0  # number of first records, of earlier runs, whose seconds do not count

    def begin_run(self) -> None:
        """Count seconds from here on."""
        self.earlier, self.closing_seconds = len(self.records), {}

    def count(self, seconds: dict[str, float]) -> None:
        """Count further seconds by stage."""
        for name, value in seconds.items():
            self.closing_seconds[name] = self.closing_seconds.get(name, 0.0) + value

    def total_seconds(self) -> dict[str, float]:
        """Seconds by stage over all frames of the last run and after them."""
        total: dict[str, float] = dict.fromkeys(STAGES, 0.0)
        records = list(self.records.values())[self.earlier :]
        for parts in (*(r.seconds for r in records), self.closing_seconds):
            for name, value in parts.items():
                total[name] += value
        return total

    def as_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "records": [vars(record) for record in self.records.values()],
            "events": self.events,
            "closing_seconds": self.closing_seconds,
            "earlier": self.earlier,
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> History:
        """The history that `as_dict` returned."""
        records = [FrameRecord(**record) for record in values["records"]]
        by_name = {record.name: record for record in records}
        closing_seconds, earlier = dict(values["closing_seconds"]), int(values["earlier"])
        return cls(by_name, list(values["events"]), closing_seconds, earlier)
