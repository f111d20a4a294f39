"""All figures of an evaluation of mapping."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.evaluation.mapping.sequences import error
from protomark.evaluation.mapping.targets import Target

FORMAT = "protomark-mapping-evaluation"
VERSION = 1


@dataclass(frozen=True)
class Drift:
    """A map made step by step beside maps made at once.

    Attributes:
        landmarks: of the map that the pipeline made.
        observations: that were added to it and not taken back.
        same_file: whether a map made at once of these observations is saved in the same bytes.
        unlike: landmarks whose count or prototype differs between the two.
        dropped: of the observations, those that bundle adjustment showed to be wrong when their
            descriptors were gone: no frame sees them any more, but they stay in the prototype.
        unlike_frames: landmarks that differ from a map of what the frames see at the end, made
            from the images: those with dropped observations.
        forgetful: landmarks with more observations than a count holds (255), which were halved.
    """

    landmarks: int
    observations: int
    same_file: bool
    unlike: int
    dropped: int
    unlike_frames: int
    forgetful: int


@dataclass(frozen=True)
class Run:
    """One variant, or COLMAP, on one sequence.

    Attributes:
        variant: its name.
        centers: image name -> camera centre, of images with a pose.
        landmarks: points of the map.
        observations: keypoints that see one.
        memory_bytes: what matching needs of all landmarks at the end, positions apart; None: of
            COLMAP, which keeps every descriptor of every image.
        peak_bytes: the most of that after any frame.
        peak_window_bytes: the most of map and window together after any frame.
        open_bytes: of prototypes: what they take while they can still be updated.
        seconds: CPU seconds by stage, all frames together.
        wall_seconds: time by the clock on the wall.
        search_ms: CPU milliseconds to encode and search a frame's descriptors in the whole map at
            the end, median over frames.
        error_pixels: mean reprojection error.
        not_registered: reason -> number of images.
        events: what happened beside: places seen again, starts that were given up.
        growth: after each frame: bytes of the map, and of all descriptors of its observations.
        drift: of prototypes.
    """

    variant: str
    centers: dict[str, list[float]]
    landmarks: int
    observations: int
    memory_bytes: int | None
    peak_bytes: int | None
    peak_window_bytes: int | None
    open_bytes: int | None
    seconds: dict[str, float]
    wall_seconds: float
    search_ms: float | None
    error_pixels: float
    not_registered: dict[str, int] = field(default_factory=dict)
    events: list[str] = field(default_factory=list)
    growth: list[int] = field(default_factory=list)
    drift: Drift | None = None

    @property
    def registered(self) -> int:
        """Images with a pose."""
        return len(self.centers)

    @property
    def total(self) -> float:
        """CPU seconds in all."""
        return sum(self.seconds.values())

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Run:
        """Back from `dataclasses.asdict`.

        Raises:
            TypeError: these are not the values of a run.
        """
        drift = values.pop("drift")
        return cls(drift=None if drift is None else Drift(**drift), **values)


@dataclass(frozen=True)
class SequenceResult:
    """All runs on one sequence.

    Attributes:
        name: of the sequence.
        frames: images that took part, of `available`.
        available: images that there are.
        truth: where the true poses come from.
        extent: diagonal of the box around the true camera centres.
        poses: image name -> (3, 4) true pose.
        runs: variant -> its run.
    """

    name: str
    frames: int
    available: int
    truth: str
    extent: float
    poses: dict[str, NDArray[np.float64]]
    runs: dict[str, Run]

    @property
    def true(self) -> dict[str, NDArray[np.float64]]:
        """Image name -> true camera centre."""
        return {name: -pose[:, :3].T @ pose[:, 3] for name, pose in self.poses.items()}

    def error(self, variant: str, beside: str = "") -> float | None:
        """Trajectory error of a variant, in units of the true poses; None: too few poses.

        Args:
            variant: whose.
            beside: another variant: only images that both registered count.
        """
        run = self.runs.get(variant)
        other = self.runs.get(beside or variant)
        if run is None or other is None:
            return None
        return error(run.centers, self.true, set(other.centers))


@dataclass(frozen=True)
class Recall:
    """Later frames of a sequence localized in a map of its earlier ones, by one kind of map.

    Attributes:
        variant: name of the kind.
        recall: share of the frames whose pose is within 5 cm and 5 degrees.
        frames: asked for.
        bytes_per_landmark: all that matching needs of one.
    """

    variant: str
    recall: float
    frames: int
    bytes_per_landmark: float


@dataclass(frozen=True)
class Results:
    """Everything that the report says.

    Attributes:
        sequences: one after the other.
        recalls: of the second half of a sequence in a map of its first half; empty: not measured.
        localized: name of that sequence.
        calibrated: names of those that said which matches to accept there.
        missing: runs that Ctrl-C left out, "sequence, variant".
        conditions: name -> text.
        targets: what was aimed at.
    """

    sequences: list[SequenceResult]
    recalls: list[Recall]
    localized: str
    calibrated: list[str]
    missing: list[str]
    conditions: dict[str, str]
    targets: list[Target] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """As JSON values; trajectories and growth are left out, the plots show them."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "conditions": self.conditions,
            "missing": self.missing,
            "sequences": [
                {
                    "name": s.name,
                    "frames": s.frames,
                    "available": s.available,
                    "truth": s.truth,
                    "extent": s.extent,
                    "runs": [
                        {
                            "registered": run.registered,
                            "error": s.error(run.variant),
                            "error_where_traditional_has_poses": s.error(
                                run.variant, "traditional"
                            ),
                            **{
                                k: v
                                for k, v in asdict(run).items()
                                if k not in ("centers", "growth")
                            },
                        }
                        for run in s.runs.values()
                    ],
                }
                for s in self.sequences
            ],
            "localization": {
                "sequence": self.localized,
                "calibrated": self.calibrated,
                "rows": [vars(r) for r in self.recalls],
            },
            "targets": [asdict(t) for t in self.targets],
        }
