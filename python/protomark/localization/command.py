"""`protomark localize`: a map and images in, poses out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.console import console, track
from protomark.localization.absolute_pose import FocalLength, pose_error
from protomark.localization.cameras import Cameras, camera_of_exif, read_cameras
from protomark.localization.frustum import PosePrior
from protomark.localization.localizer import Localizer
from protomark.localization.poses import GivenPoses, read_poses
from protomark.localization.results import CAMERAS, POSES, TABLE, ImageResult, Results
from protomark.tracks.features import read_gray

if TYPE_CHECKING:
    from protomark.tracks.file import Camera

_ENDINGS = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"}


@dataclass(frozen=True)
class Settings:
    """How images are localized.

    Attributes:
        camera: a cameras.txt, a folder with a COLMAP model, or a camera written out; None: focal
            lengths come from EXIF data and matches.
        refine_focal_length: whether focal lengths of given cameras are refined for each image.
        true_poses: poses to measure against; None: nothing is measured.
        priors: rough poses; None: the whole map is searched.
        prior_distance: the priors' error in world units.
        prior_degrees: the priors' error.
        min_confidence: poses at least so likely to be right are written.
        max_keypoints: keypoints kept in an image.
        threads: threads to encode and search on.
    """

    camera: str | None = None
    refine_focal_length: bool = False
    true_poses: Path | None = None
    priors: Path | None = None
    prior_distance: float = 1.0
    prior_degrees: float = 15.0
    min_confidence: float = 0.9
    max_keypoints: int = 2000
    threads: int = 1


def localize_files(
    scene: Path, images: Sequence[Path], output: Path, settings: Settings
) -> tuple[Results, bool]:
    """Localize images and write poses; one that cannot be read does not end the run.

    Args:
        scene: a map.
        images: files, and folders of them.
        output: folder for the poses; it is made if it is not there.
        settings: see `Settings`.

    Returns:
        The results, and whether Ctrl-C ended the run early.

    Raises:
        FileNotFoundError, ValueError: the map, cameras or poses do not serve, or no image can be
            read.
        FileExistsError: the folder holds another COLMAP model.
    """
    found = list_images(images)
    if (output / POSES).exists() and not (output / TABLE).exists():
        raise FileExistsError(
            f"{output} holds a COLMAP model that is not of `protomark localize`: name another "
            "folder with -o"
        )
    localizer = Localizer(
        pm.open(scene), max_keypoints=settings.max_keypoints, threads=settings.threads
    )
    cameras = read_cameras(settings.camera) if settings.camera else None
    true_poses = read_poses(settings.true_poses) if settings.true_poses else GivenPoses({})
    priors = read_poses(settings.priors) if settings.priors else GivenPoses({})
    for source, poses in ((settings.true_poses, true_poses), (settings.priors, priors)):
        if source and all(poses.of(name) is None for name, _ in found):
            raise ValueError(
                f"{source}: none of its {len(poses)} poses is of one of the images, {found[0][0]} "
                f"for example; it has {poses.example}"
            )
    output.mkdir(parents=True, exist_ok=True)
    results: list[ImageResult] = []
    interrupted = False
    try:
        for name, path in track(found, "localizing"):
            prior = priors.of(name)
            results.append(
                _localize(
                    localizer,
                    name,
                    path,
                    cameras,
                    settings,
                    None
                    if prior is None
                    else PosePrior(prior, settings.prior_distance, settings.prior_degrees),
                    true_poses.of(name),
                )
            )
    except KeyboardInterrupt:
        interrupted = True
    if results and all(result.found is None for result in results):
        raise ValueError(
            f"none of {len(results)} images can be localized; {results[0].name}: {results[0].error}"
        )
    everything = Results(results, settings.min_confidence)
    everything.write(output)
    return everything, interrupted


def list_images(sources: Sequence[Path]) -> list[tuple[str, Path]]:
    """Names and paths of images, those of a folder in natural order and named from there.

    Raises:
        FileNotFoundError: a source is missing, or a folder holds no image.
        ValueError: two images have the same name.
    """
    from protomark.tracks.colmap import natural_key

    found: dict[str, Path] = {}
    for source in sources:
        if source.is_dir():
            inside = [p for p in source.rglob("*") if p.suffix.lower() in _ENDINGS and p.is_file()]
            named = {str(p.relative_to(source)): p for p in inside}
            if not named:
                raise FileNotFoundError(f"{source}: no image in this folder")
        elif source.is_file():
            named = {source.name: source}
        else:
            raise FileNotFoundError(f"{source}: no such image or folder")
        for name in sorted(named, key=natural_key):
            if name in found:
                raise ValueError(f"two images are called {name}: {found[name]} and {named[name]}")
            found[name] = named[name]
    return list(found.items())


def _localize(
    localizer: Localizer,
    name: str,
    path: Path,
    cameras: Cameras | None,
    settings: Settings,
    prior: PosePrior | None,
    true_pose: NDArray[np.float64] | None,
) -> ImageResult:
    camera: Camera | None
    focal_length: FocalLength = "rough" if settings.refine_focal_length else "known"
    try:
        pixels = read_gray(path)
        if cameras is None:
            camera, focal_length = camera_of_exif(path), "rough"
        else:
            camera = cameras.find(name, pixels.shape[1], pixels.shape[0])
        found = localizer.localize(pixels, camera, prior, focal_length=focal_length)
    except (OSError, ValueError) as error:
        missed = None if true_pose is None else (np.inf, np.inf)
        return ImageResult(name, None, str(error), missed)
    off = None
    if true_pose is not None:
        off = (np.inf, np.inf)
        if found.cam_from_world is not None:
            off = pose_error(found.cam_from_world, true_pose)
    return ImageResult(name, found, true_error=off)


def show(results: Results, output: Path) -> None:
    """Print the summary."""
    from rich.table import Table

    facts = results.summary()
    table = Table.grid(padding=(0, 2))
    table.add_row("images", f"{facts['images']:,}")
    table.add_row(
        "localized", f"{facts['localized']:,} (confidence {results.min_confidence:g} or more)"
    )
    table.add_row("less certain poses", f"{facts['below_confidence']:,}")
    if facts["unreadable"]:
        table.add_row("not localized for an error", f"{facts['unreadable']:,}")
    if facts["median_inliers"] is not None:
        table.add_row("median inliers", f"{facts['median_inliers']:,.0f}")
    times = facts["median_seconds"]
    if times:
        text = ", ".join(f"{stage} {1000 * times[stage]:.1f}" for stage in times)
        table.add_row("median milliseconds", text)
    if facts["with_true_pose"]:
        for row in facts["recall"]:
            label = f"recall at {row['distance']:g}, {row['degrees']:g} degrees"
            table.add_row(label, f"{row['recall']:.3f} of {facts['with_true_pose']:,}")
        if facts["median_position_error"] is not None:
            table.add_row(
                "median error of localized",
                f"{facts['median_position_error']:.4g}, {facts['median_angle_error']:.3g} degrees",
            )
    console.print(table)
    bad = [image for image in results.images if image.error]
    for image in bad[:5]:
        console.print(f"{image.name}: {image.error}", markup=False, highlight=False)
    if len(bad) > 5:
        console.print(f"... and {len(bad) - 5} more, in {output / TABLE}", highlight=False)
    console.print(
        f"{output / POSES}, {CAMERAS} and {TABLE}", markup=False, highlight=False, soft_wrap=True
    )
