"""Starts a map anew where its first focal length proves wrong, or lets several starts compete."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from protomark.geometry.camera import Camera
from protomark.mapping.adjustment import other_factors
from protomark.mapping.frame import InputImage
from protomark.mapping.mapper import FIRST_GLOBAL, Mapper
from protomark.mapping.self_calibration import Calibration

# A map that started with a guess competes with maps that start with so many times the longer side
# if its first keyframes leave the focal length open.
_RIVALS = (0.6, 2.4)
_KEYFRAMES = 16
# A rival wins if it explains so many times as much.
_LEAD = 1.1
_EVENT = "the map restarts"


def needs_restart(mapper: Mapper, at_end: bool = False) -> bool:
    """Whether the camera proved so different from the start that the map has to restart.

    Once no frame is left, the existing keyframes decide.
    """
    if mapper.calibration is None:
        return False
    if at_end and len(mapper.structure.keyframes()) >= FIRST_GLOBAL:
        mapper.adjust_global_bundle(2)
    return mapper.calibration.needs_restart(mapper.camera.focal_length)


def restart(mapper: Mapper) -> Mapper:
    """An empty map that starts with the camera which this one calibrated."""
    assert mapper.calibration is not None
    new = _anew(mapper, mapper.camera, mapper.calibration.restarted(mapper.camera.focal_length))
    new.history.count(mapper.history.total_seconds())
    return new


def needs_rivals(mapper: Mapper, at_end: bool = False) -> bool:
    """Whether maps that start with other focal lengths are to compete with this one."""
    calibration = mapper.calibration
    young = not at_end and len(mapper.structure.keyframes()) < _KEYFRAMES
    if calibration is None or not calibration.guessed or young:
        return False
    calibration.guessed = not calibration.determined or bool(other_factors(mapper.structure))
    return calibration.guessed


def compete(
    mapper: Mapper, images: Iterable[InputImage], stopped: Callable[[], bool]
) -> Mapper | None:
    """The map of its images that explains most: this one or a rival; None if it is to stop."""
    assert mapper.calibration is not None
    longer_side = max(mapper.camera.width, mapper.camera.height)
    rivals = []
    for focal in (share * longer_side for share in _RIVALS):
        camera = replace(mapper.camera, params=(focal, *mapper.camera.params[1:3], 0.0))
        rivals.append(_anew(mapper, camera, Calibration(focal)))
    for image in images:
        if stopped():
            return None
        for rival in rivals:
            rival.add(image)
    best = max(rivals, key=_explained)
    if _explained(best) < _LEAD * _explained(mapper):
        best = mapper
    for other in (mapper, *rivals):
        if other is not best:
            best.history.count(other.history.total_seconds())
    assert best.calibration is not None
    best.calibration.guessed = False
    return best


def _anew(mapper: Mapper, camera: Camera, calibration: Calibration) -> Mapper:
    """An empty map of the same images, whose camera is to be calibrated."""
    assert mapper.calibration is not None
    new = Mapper(mapper.options, camera, mapper.threads, mapper.new_memory)
    new.calibration = calibration
    new.features, new.mask = mapper.features, mapper.mask
    new.history.events = [e for e in mapper.history.events if e.startswith(_EVENT)]
    new.history.events.append(
        f"{_EVENT}: focal length {calibration.start:.0f}, not {mapper.calibration.start:.0f} pixels"
    )
    return new


def _explained(mapper: Mapper) -> float:
    """How much a map explains: each observation counts 1 minus its squared error over the limit."""
    structure = mapper.structure
    errors = structure.errors(structure.observations(range(len(structure.frames))))
    return float(np.maximum(1 - (errors / structure.max_error(mapper.camera_id)) ** 2, 0).sum())
