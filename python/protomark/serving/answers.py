"""Answers requests: from the bytes that came to the message that goes."""

from __future__ import annotations

import time

from protomark.geometry.camera import Camera
from protomark.geometry.pose import camera_centers, quaternion_from_rotation
from protomark.localization.confidence import MIN_CONFIDENCE
from protomark.localization.localizer import ESTIMATE, Localizer
from protomark.localization.solve import Localization
from protomark.serving.messages import Answer, CameraMessage, MatchesMessage, Pose
from protomark.serving.metrics import log
from protomark.serving.reading import FrameRequest, Limits, Refusal, Upload, feature_camera, parse


def localize_request(localizer: Localizer, asked: FrameRequest) -> Localization:
    """The pose of an image or of features, as `protomark localize` finds it."""
    if asked.image is None:
        camera = feature_camera(asked.camera, localizer.cameras.cameras)
        return localizer.localize_features(
            asked.keypoints,
            asked.descriptors,
            camera,
            asked.prior,
            focal_length=asked.focal_length,
        )
    height, width = asked.image.shape
    focal_length = asked.focal_length
    found = asked.camera or localizer.map_camera(width, height)
    if found is None:
        found, focal_length = asked.exif(), "rough"
    return localizer.localize(
        asked.image, found or ESTIMATE, asked.prior, focal_length=focal_length
    )


def answer_of(localizer: Localizer, upload: Upload, limits: Limits, waited: float) -> Answer:
    """Decode a request and answer it.

    Raises:
        Refusal: it cannot be answered.
    """
    began = time.perf_counter()
    asked = parse(upload, limits, localizer.scene.encoder.bits // 8)
    decoded = time.perf_counter() - began
    try:
        found = localize_request(localizer, asked)
        details = _details(localizer, found) if asked.details else None
    except KeyError:  # a shard has gone between the pose and its details
        raise Refusal(503, "the map is changing: try again in 1 s", 1) from None
    except OSError as error:  # FileError, too
        log.error("the map cannot be read: %s", error)
        raise Refusal(503, "the map cannot be read now: try again in 5 s", 5) from None
    except ValueError as error:
        raise Refusal(422, str(error)) from None
    stages = {"wait": waited, "decode": decoded, **found.seconds}
    stages["total"] = waited + time.perf_counter() - began
    pose = found.cam_from_world
    return Answer(
        cam_from_world=None
        if pose is None
        else Pose(
            quaternion=tuple(quaternion_from_rotation(pose[:, :3])), translation=tuple(pose[:, 3])
        ),
        center=None if pose is None else tuple(camera_centers(pose)),
        covariance=None if found.covariance is None else found.covariance.tolist(),
        confidence=found.confidence,
        accepted=pose is not None and found.confidence >= MIN_CONFIDENCE,
        inliers=found.inliers,
        matches=found.evidence.matches,
        camera=CameraMessage(**found.camera.as_dict()),
        place=found.place,
        reason=found.reason,
        warnings=_doubts(asked.camera, found.camera),
        seconds=stages,
        details=details,
    )


def _details(localizer: Localizer, found: Localization) -> MatchesMessage:
    return MatchesMessage(
        pixels=found.pixels.tolist(),
        landmarks=found.landmarks.tolist(),
        positions=localizer.scene.positions(found.landmarks).tolist(),
    )


def _doubts(given: Camera | None, used: Camera) -> list[str]:
    if given is None:
        return []
    doubt = given.sized(used.width, used.height).lens_doubt()
    return [doubt] if doubt else []
