"""The camera that the images of a run share: right ones stay, zoomed ones are named."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

import protomark as pm
from mapping_scene import PINHOLE, show
from protomark.localization import Localization, Localizer
from protomark.localization.confidence import CameraOrigin, Evidence
from protomark.localization.shared_camera import check_shared_cameras
from protomark.mapping.frame import InputImage
from protomark.mapping.mapper import Mapper
from protomark.mapping.options import MappingOptions
from protomark.maps.cameras import KEY, cameras_text
from test_mapping_trust import turn_and_approach


def found(
    stretch: float, deviation: float, origin: CameraOrigin = "map", inliers: int = 300
) -> Localization:
    evidence = Evidence(inliers, 320, inliers // 5, origin, stretch=stretch, deviation=deviation)
    return Localization(PINHOLE, np.eye(3, 4), evidence=evidence, confidence=0.95)


def run(
    stretch: float,
    spread: float = 0.01,
    count: int = 12,
    deviation: float = 0.003,
    origin: CameraOrigin = "map",
    inliers: int = 300,
) -> list[Localization]:
    noise = np.exp(np.linspace(-1, 1, count) * spread)
    return [found(stretch * factor, deviation, origin, inliers) for factor in noise]


@pytest.mark.parametrize(
    ("images", "named", "believed"),
    [
        (run(1.0), False, True),
        (run(1.11), True, False),
        (run(0.9), True, False),
        (run(1.04), True, True),  # poses are off by less than 5 % of the depth
        (run(1.02), False, True),
        (run(1.11, spread=0.2), False, True),  # a flat scene: the images do not agree
        (run(1.11, deviation=0.03), False, True),  # none of them knows
        (run(1.11, count=7), False, True),
        (run(1.11, origin="estimate"), False, True),  # each image has its own
        (run(1.11, inliers=8), False, True),  # perhaps of another place
    ],
)
def test_images_that_agree_on_another_focal_length(
    images: list[Localization], named: bool, believed: bool
) -> None:
    alone = replace(images[0], camera=PINHOLE.zoomed(2))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        checked = check_shared_cameras([*images, alone])
    assert len(caught) == named
    assert all((one.confidence == 0.95) == believed for one in checked[:-1])
    assert checked[-1] == alone
    if not believed:
        focal = round(300 * float(np.exp(np.median(np.log([i.evidence.stretch for i in images])))))
        assert f"{len(images)} images fit a focal length of {focal} pixels" in checked[0].reason


def test_zoomed_images_are_not_believed_and_their_camera_is_found() -> None:
    mapper = Mapper(MappingOptions(descriptor="orb", max_keypoints=1500), PINHOLE)
    poses = turn_and_approach(16)
    for i, pose in enumerate(poses):
        mapper.add(InputImage(i, f"{i}.png", float(i), show(pose)))
    mapper.finish()
    ids = mapper.scene.ids
    mapper.scene.set_positions(ids, mapper.structure.positions[ids])
    mapper.scene.metadata = {KEY: cameras_text([PINHOLE])}
    localizer = Localizer(mapper.scene)
    beside = poses.copy()
    beside[:, :, 3] += 0.03
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        right = localizer.localize_many([show(pose) for pose in beside])
    assert sum(one.confidence > 0.9 for one in right) >= 12
    zoomed = [show(pose, PINHOLE.zoomed(1.12)) for pose in beside]
    with pytest.warns(UserWarning, match=r"images fit a focal length of 3[34]\d pixels"):
        wrong = localizer.localize_many(zoomed)
    assert all(one.confidence == 0 for one in wrong)
    camera = pm.Camera.parse(wrong[0].reason.rpartition(" ")[2])
    assert camera.params[0] == pytest.approx(336, rel=0.02)
    mended = localizer.localize_many(zoomed, camera)
    assert sum(one.confidence > 0.5 for one in mended) >= 9
