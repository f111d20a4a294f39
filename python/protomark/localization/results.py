"""What localizing some images came to: files and figures."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.files import write_text
from protomark.localization.absolute_pose import centre
from protomark.localization.poses import images_txt
from protomark.localization.solve import Localization

POSES, CAMERAS, POINTS, TABLE = "images.txt", "cameras.txt", "points3D.txt", "poses.csv"
# Distance in world units (metres where the map is metric) and degrees, as hloc reports them.
THRESHOLDS = ((0.05, 5.0), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
STAGES = ("features", "encode", "search", "pose", "total")


@dataclass(frozen=True)
class ImageResult:
    """One image: what was found, or what was wrong with it.

    Attributes:
        name: of the image.
        found: None where it could not be read.
        error: what was wrong, or "".
        true_error: distance and degrees from the true pose, infinite without a pose; None where
            no true pose was given.
    """

    name: str
    found: Localization | None
    error: str = ""
    true_error: tuple[float, float] | None = None

    @property
    def confidence(self) -> float:
        """Probability that the pose is right, 0 without one."""
        return self.found.confidence if self.found else 0.0

    @property
    def note(self) -> str:
        """Why there is no pose, or ""."""
        return self.error or (self.found.reason if self.found else "")

    def as_dict(self) -> dict[str, Any]:
        """As JSON values, and as a row of the table."""
        found = self.found
        pose = found.cam_from_world if found else None
        return {
            "image": self.name,
            "confidence": round(self.confidence, 6),
            "inliers": found.inliers if found else 0,
            "matches": found.evidence.matches if found else 0,
            "cam_from_world": None if pose is None else pose.tolist(),
            "focal_length": None if pose is None or found is None else found.camera.params[0],
            "position_error": self.true_error[0] if self.true_error else None,
            "angle_error": self.true_error[1] if self.true_error else None,
            "seconds": {k: round(v, 6) for k, v in found.seconds.items()} if found else {},
            "note": self.note,
        }


@dataclass(frozen=True)
class Results:
    """All images of one run.

    Attributes:
        images: in their order.
        min_confidence: poses at least so likely to be right are written and counted.
    """

    images: Sequence[ImageResult]
    min_confidence: float

    def pose(self, image: ImageResult) -> NDArray[np.float64] | None:
        """Its pose if that is likely enough, else None."""
        if image.found is None or image.found.confidence < self.min_confidence:
            return None
        return image.found.cam_from_world

    def accepted(self, image: ImageResult) -> bool:
        """Whether its pose is likely enough."""
        return self.pose(image) is not None

    def recall(self) -> list[dict[str, float]]:
        """Share of the images with a true pose that were accepted within each of `THRESHOLDS`."""
        known = [i for i in self.images if i.true_error is not None]
        rows = []
        for distance, degrees in THRESHOLDS if known else ():
            right = [
                self.accepted(i)
                and i.true_error is not None
                and i.true_error[0] <= distance
                and i.true_error[1] <= degrees
                for i in known
            ]
            rows.append({"distance": distance, "degrees": degrees, "recall": float(np.mean(right))})
        return rows

    def summary(self) -> dict[str, Any]:
        """Figures over all images."""
        accepted = [i for i in self.images if self.accepted(i)]
        timed = [i.found.seconds for i in self.images if i.found]
        errors = np.array([i.true_error for i in accepted if i.true_error is not None])
        return {
            "images": len(self.images),
            "localized": len(accepted),
            "below_confidence": sum(
                i.found is not None and i.found.cam_from_world is not None for i in self.images
            )
            - len(accepted),
            "unreadable": sum(i.found is None for i in self.images),
            "min_confidence": self.min_confidence,
            "median_inliers": float(np.median([i.found.inliers for i in accepted if i.found]))
            if accepted
            else None,
            "median_seconds": {
                stage: float(np.median([s[stage] for s in timed if stage in s]))
                for stage in STAGES
                if any(stage in s for s in timed)
            },
            "with_true_pose": sum(i.true_error is not None for i in self.images),
            "median_position_error": float(np.median(errors[:, 0])) if len(errors) else None,
            "median_angle_error": float(np.median(errors[:, 1])) if len(errors) else None,
            "recall": self.recall(),
        }

    def as_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return {**self.summary(), "each": [i.as_dict() for i in self.images]}

    def write(self, folder: Path) -> None:
        """Write a COLMAP model of the accepted poses, and a table of all images."""
        cameras: dict[str, int] = {}
        poses, camera_ids = {}, {}
        for image in self.images:
            pose = self.pose(image)
            if image.found is None or pose is None:
                continue
            camera = image.found.camera
            params = " ".join(f"{p:.12g}" for p in camera.params)
            line = f"{camera.model} {camera.width} {camera.height} {params}"
            poses[image.name] = pose
            camera_ids[image.name] = cameras.setdefault(line, len(cameras) + 1)
        text = "".join(f"{number} {line}\n" for line, number in cameras.items())
        write_text(folder / CAMERAS, f"# CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS\n{text}")
        write_text(folder / POSES, images_txt(poses, camera_ids))
        write_text(folder / POINTS, "# The landmarks are in the map\n")
        write_text(folder / TABLE, self.table())

    def table(self) -> str:
        """All images as CSV; the pose as the camera's centre and the rows of its rotation."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        header = ["image", "accepted", "confidence", "inliers", "matches", "x", "y", "z"]
        header += [f"r{i}{j}" for i in range(3) for j in range(3)]
        header += ["focal_length", "position_error", "angle_error"]
        writer.writerow([*header, *(f"seconds_{stage}" for stage in STAGES), "note"])
        for image in self.images:
            row = image.as_dict()
            pose = image.found.cam_from_world if image.found else None
            numbers = [""] * 12 if pose is None else [*centre(pose), *pose[:, :3].ravel()]
            start = (row[key] for key in ("image", "confidence", "inliers", "matches"))
            name, confidence, inliers, matches = start
            writer.writerow(
                [
                    *(name, int(self.accepted(image)), confidence, inliers, matches),
                    *(n if isinstance(n, str) else f"{n:.9g}" for n in numbers),
                    *(row[key] for key in ("focal_length", "position_error", "angle_error")),
                    *(row["seconds"].get(stage, "") for stage in STAGES),
                    row["note"],
                ]
            )
        return out.getvalue()
