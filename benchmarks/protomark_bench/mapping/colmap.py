"""Runs COLMAP's incremental reconstruction with SIFT on the same images."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from protomark.geometry.colmap import pycolmap, quiet
from protomark_bench.mapping.results import COLMAP, MappingRun

if TYPE_CHECKING:
    from protomark_bench.mapping.sequences import ImageSequence

# All pairs of up to so many images are matched; of more images, those that are up to ten, or a
# power of two, apart.
EXHAUSTIVE = 40


def run(
    sequence: ImageSequence, threads: int, advance: Callable[[], None] = lambda: None
) -> MappingRun:
    """Reconstructs a sequence with COLMAP's defaults and the known camera, on the CPU.

    Args:
        sequence: the images.
        threads: threads of each step.
        advance: called after each registered image.
    """
    source, seconds = sequence.source, {}
    began, since = time.perf_counter(), time.process_time()

    def lap(stage: str) -> None:
        nonlocal since
        now = time.process_time()
        seconds[stage], since = round(now - since, 3), now

    with quiet(), tempfile.TemporaryDirectory(prefix="protomark-") as temporary:
        database = Path(temporary) / "database.db"
        _extract(sequence, database, threads)
        lap("detect")
        _match(database, len(source), threads)
        lap("match")
        models = pycolmap.incremental_mapping(
            database,
            source.path,
            temporary,
            options=_mapping_options(threads),
            next_image_callback=advance,
        )
        lap("map")
    best = max(models.values(), key=lambda m: m.num_reg_images(), default=None)
    return _run_of(best, len(source), len(models), seconds, time.perf_counter() - began)


def _extract(sequence: ImageSequence, database: Path, threads: int) -> None:
    camera = sequence.camera
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = camera.model
    reader.camera_params = ",".join(repr(p) for p in camera.params)
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = threads
    pycolmap.extract_features(
        database,
        sequence.source.path,
        image_names=sequence.source.names(),
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )


def _match(database: Path, images: int, threads: int) -> None:
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    match = pycolmap.match_exhaustive if images <= EXHAUSTIVE else pycolmap.match_sequential
    match(database, matching_options=matching, device=pycolmap.Device.cpu)


def _mapping_options(threads: int) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = threads
    options.random_seed = options.mapper.random_seed = 0
    # The camera is known, as in the pipeline, but by default COLMAP rejects coefficients above 1
    # and registers nothing.
    for bounds in (options, options.mapper, options.triangulation):
        bounds.max_extra_param = 1e12
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    return options


def _run_of(
    best: Any, images: int, models: int, seconds: dict[str, float], wall: float
) -> MappingRun:
    centers = {}
    if best is not None:
        posed = (image for image in best.images.values() if image.has_pose)
        centers = {i.name: [float(x) for x in i.projection_center()] for i in posed}
    unregistered = images - len(centers)
    return MappingRun(
        memory=COLMAP,
        registered=len(centers),
        centers=dict(sorted(centers.items())),
        landmarks=0 if best is None else best.num_points3D(),
        observations=0 if best is None else best.compute_num_observations(),
        memory_bytes=None,
        peak_bytes=None,
        peak_window_bytes=None,
        learning_bytes=None,
        seconds=seconds,
        wall_seconds=wall,
        search_ms=None,
        error_pixels=0.0 if best is None else float(best.compute_mean_reprojection_error()),
        not_registered={"not in the largest model": unregistered} if unregistered else {},
        events=[f"{models} models, the largest counts"] if models > 1 else [],
    )
