"""What requests and answers hold, as the OpenAPI page describes them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from protomark.geometry.camera import CAMERA_EXAMPLE
from protomark.localization.confidence import MIN_CONFIDENCE

Vector3 = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
Vector4 = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]


class _Message(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Pose(_Message):
    """A rigid motion from the world to the camera, in COLMAP's order (QW QX QY QZ TX TY TZ)."""

    quaternion: Annotated[Vector4, Field(description="w, x, y, z; of length 1")]
    translation: Annotated[Vector3, Field(description="x, y, z in the map's unit")]


class CameraMessage(_Message):
    """A COLMAP camera. The centre of the upper left pixel is (0.5, 0.5)."""

    model: Annotated[str, Field(examples=["PINHOLE"])]
    width: Annotated[int, Field(description="pixels")]
    height: Annotated[int, Field(description="pixels")]
    params: Annotated[list[FiniteFloat], Field(description="in COLMAP's order for the model")]


class _Settings(_Message):
    prior_distance: Annotated[
        FiniteFloat, Field(ge=0, description="largest error of the prior's centre, map's unit")
    ] = 1.0
    prior_degrees: Annotated[
        FiniteFloat, Field(ge=0, description="largest error of the prior's orientation, degrees")
    ] = 15.0
    focal_length: Annotated[
        Literal["known", "rough", "unknown"],
        Field(description="of the camera: known, to be refined, or to be estimated"),
    ] = "known"
    details: Annotated[
        bool, Field(description="answer with the matches that agree with the pose, too")
    ] = False


class Settings(_Settings):
    """What a request says beside an image or features, in its URL or as fields of a form."""

    camera: Annotated[
        str | None,
        Field(
            description="COLMAP's MODEL WIDTH HEIGHT PARAMETERS, or MODEL:PARAMETERS for images. "
            "Without it: the camera of the map if that has the image's size, or else an estimate "
            "by EXIF data and matches.",
            examples=[CAMERA_EXAMPLE],
        ),
    ] = None
    prior: Annotated[
        str | None,
        Field(description="rough cam_from_world as QW QX QY QZ TX TY TZ, as in images.txt"),
    ] = None


class FeaturesMessage(_Settings):
    """Keypoints and descriptors as JSON."""

    keypoints: Annotated[
        list[tuple[FiniteFloat, FiniteFloat]],
        Field(description="x, y in pixels; the centre of the upper left pixel is (0.5, 0.5)"),
    ]
    descriptors: Annotated[
        str, Field(description="base64 of the descriptors' bytes, one keypoint after the other")
    ]
    camera: CameraMessage | str | None = None
    prior: Annotated[Pose | None, Field(description="rough cam_from_world")] = None


class MatchesMessage(_Message):
    """The matches that agree with the pose; all lists have its number of inliers."""

    pixels: Annotated[list[tuple[float, float]], Field(description="keypoints, x, y")]
    landmarks: Annotated[list[int], Field(description="ids of the landmarks that they observe")]
    positions: Annotated[list[Vector3], Field(description="of these landmarks in the world")]


class Answer(_Message):
    """Where a frame was taken, and how sure that is."""

    cam_from_world: Annotated[Pose | None, Field(description="null if no pose was found")]
    center: Annotated[Vector3 | None, Field(description="the camera's centre in the world")]
    covariance: Annotated[
        list[list[float]] | None,
        Field(
            description="(6, 6) of the rotation (radians, in the camera) and the translation; null "
            "without a pose, or if its inliers leave a direction open"
        ),
    ]
    confidence: Annotated[float, Field(description="probability that the pose is right")]
    accepted: Annotated[
        bool, Field(description=f"whether there is a pose of confidence {MIN_CONFIDENCE:g} or more")
    ]
    inliers: Annotated[int, Field(description="number of keypoints that agree with the pose")]
    matches: Annotated[int, Field(description="number of accepted matches")]
    camera: Annotated[
        CameraMessage, Field(description="with the focal length that was refined or estimated")
    ]
    place: Annotated[str, Field(description="which place of a map of several")]
    reason: Annotated[str, Field(description="why there is no pose, or an unlikely one")]
    warnings: Annotated[list[str], Field(description="doubts about the camera")]
    seconds: Annotated[
        dict[str, float],
        Field(description="wait (for a thread), decode, features, encode, search, pose, total"),
    ]
    details: MatchesMessage | None = None


class Health(_Message):
    """The state of the server."""

    status: Literal["ok"]
    version: str
    landmarks: int
    descriptor: Annotated[str, Field(description="what features have to be")]
    in_progress: Annotated[int, Field(description="requests that are being answered")]
    waiting: Annotated[int, Field(description="those of them that wait for a thread")]


class Problem(_Message):
    """Why a request was refused: one sentence."""

    detail: str
