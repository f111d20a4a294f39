"""What became of each frame, and how the map grew."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

REGISTERED = "registered"


@dataclass
class Entry:
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
    """Entries by frame, in the order in which frames came, and what happened beside.

    Attributes:
        entries: name of the frame -> its entry.
        events: sentences such as "frame 31: a place seen before, 45 landmarks merged".
        later: seconds by stage that belong to no frame (second looks, last adjustment).
    """

    entries: dict[str, Entry] = field(default_factory=dict)
    events: list[str] = field(default_factory=list)
    later: dict[str, float] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "entries": [vars(entry) for entry in self.entries.values()],
            "events": self.events,
            "later": self.later,
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> History:
        """Back from `as_dict`."""
        entries = [Entry(**entry) for entry in values["entries"]]
        return cls({e.name: e for e in entries}, list(values["events"]), dict(values["later"]))
