"""Checks the camera that the images of a run share: together they tell its focal length best."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from protomark.localization.confidence import place_probability
from protomark.localization.solve import Localization

# A camera is judged by at least so many images that are most probably of this place.
_MIN_IMAGES = 8
_MIN_PLACE = 0.5
# Another focal length is named if it is this share longer or shorter, and so many standard
# deviations. Poses that are off by more than the second share of the depth are wrong.
_NAMED, _WRONG, _SIGMAS = 0.025, 0.05, 5.0
# Landmarks are not exact, as the deviation of one image's focal length takes them to be.
_INEXACT = 3.0


def check_shared_cameras(found: Sequence[Localization]) -> list[Localization]:
    """Warn of cameras whose images agree on another focal length, and believe no such pose.

    One image hardly tells a zoom from a step forward. Over the images of a run the errors of that
    cancel: their median is off by far less.
    """
    out = list(found)
    for camera in {one.camera for one in found}:
        rows = [i for i, one in enumerate(found) if one.camera == camera and _is_known(one)]
        stretch = _common_stretch([found[i] for i in rows])
        if abs(np.log(stretch)) <= _NAMED:
            continue
        better = camera.zoomed(stretch)
        params = ",".join(f"{p:.6g}" for p in better.params)
        told = (
            f"{len(rows)} images fit a focal length of {better.focal_length:.0f} pixels, not "
            f"{camera.focal_length:.0f}: another lens or zoom? Try camera {better.model}:{params}"
        )
        warnings.warn(told, stacklevel=2)
        if abs(np.log(stretch)) > _WRONG:
            for i in rows:
                out[i] = replace(found[i], confidence=0.0, reason=told)
    return out


def _is_known(one: Localization) -> bool:
    """Whether a pose relies on a focal length that was not estimated from its image."""
    known = one.evidence.origin != "estimate" and not one.camera.wide
    return known and one.cam_from_world is not None


def _common_stretch(found: Sequence[Localization]) -> float:
    """The focal length that most images fit, by that of their camera; 1 if they do not tell."""
    evidence = [one.evidence for one in found if place_probability(one.evidence) >= _MIN_PLACE]
    evidence = [one for one in evidence if np.isfinite(one.deviation)]
    if len(evidence) < _MIN_IMAGES:
        return 1.0
    logs = np.log([one.stretch for one in evidence])
    middle = float(np.median(logs))
    spread = max(
        1.4826 * float(np.median(np.abs(logs - middle))),
        _INEXACT * float(np.median([one.deviation for one in evidence])),
    )
    # The median of n normal numbers deviates by 1.25 / sqrt(n) of their deviation.
    return (
        float(np.exp(middle)) if abs(middle) > _SIGMAS * 1.25 * spread / len(logs) ** 0.5 else 1.0
    )
