"""Records what became of each frame, and how the map grew."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

REGISTERED = "registered"


@dataclass
class FrameRecord:
    """One frame of the input.

    Attributes:
        index: place in its input.
        name: image name.
        outcome: "registered", or why not, in words.
        keypoints: found in it.
        inliers: matches that agree with its pose, 0 without one.
        keyframe: whether it is a keyframe.
        landmarks: landmarks of the map after it.
        observations: observations of the map after it.
        memory_bytes: what matching needs after it.
        descriptor_bytes: what all descriptors of these observations would take.
        window_bytes: descriptors that the window keeps to triangulate.
        seconds: by stage.
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
    """Records of all frames, in the order in which they came, and events.

    Attributes:
        records: name of the frame -> its record.
        events: sentences such as "frame 31: a place seen before, 45 landmarks merged".
        closing_seconds: seconds by stage that belong to no frame (retries, last adjustment).
    """

    records: dict[str, FrameRecord] = field(default_factory=dict)
    events: list[str] = field(default_factory=list)
    closing_seconds: dict[str, float] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "records": [vars(record) for record in self.records.values()],
            "events": self.events,
            "closing_seconds": self.closing_seconds,
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> History:
        """Back from `as_dict`."""
        records = [FrameRecord(**record) for record in values["records"]]
        return cls(
            {e.name: e for e in records}, list(values["events"]), dict(values["closing_seconds"])
        )
