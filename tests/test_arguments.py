"""Arguments of wrong types or far out of range raise errors that name them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import protomark as pm

CODES = np.ones((2, 12), np.int8)


@pytest.fixture(params=["learning", "sealed"])
def scene(
    request: pytest.FixtureRequest, encoder: pm.Encoder, tmp_path: Path
) -> pm.PrototypeMap | pm.SealedMap:
    learning = pm.PrototypeMap(encoder)
    learning.add_codes([1, 2], CODES)
    return learning if request.param == "learning" else learning.seal(tmp_path / "s.pmk")


def refused(call: Callable[[], object], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        call()


def test_searches_name_what_they_refuse(scene: pm.PrototypeMap | pm.SealedMap) -> None:
    # OpenCV gives None for the descriptors of an image without keypoints.
    refused(lambda: scene.search(None), TypeError, "descriptors: .* is needed, not None")  # type: ignore[arg-type]
    refused(lambda: scene.search_codes(None), TypeError, "codes: .* is needed, not None")  # type: ignore[arg-type]
    refused(lambda: scene.search_codes(CODES, -1), ValueError, "k must be at least 1")
    refused(
        lambda: scene.search_codes(CODES, threads=None),  # type: ignore[arg-type]
        TypeError,
        "threads: an integer is needed, not None",
    )
    for k in (2**62, 2**63, 2**70):
        for codes in (CODES, CODES[:0]):
            with pytest.raises(MemoryError):
                scene.search_codes(codes, k)
    # More threads are as good as 256.
    assert scene.search_codes(CODES, 1, threads=2**40)[0].tolist() == [[1], [1]]


def test_ids_are_named_as_they_are(scene: pm.PrototypeMap | pm.SealedMap) -> None:
    above = "landmark id 9223372036854775808 is above"
    refused(lambda: scene.appearances(2**63), ValueError, above)
    refused(lambda: scene.positions(np.array([2**63], np.uint64)), ValueError, above)


def test_lengths_of_codes(encoder: pm.Encoder) -> None:
    for dim in (0, -1):
        refused(lambda d=dim: encoder.match_calibration(d), ValueError, "dim must be at least 1")  # type: ignore[misc]
        refused(lambda d=dim: pm.PrototypeMap(encoder, d), ValueError, "dim must be at least 1")  # type: ignore[misc]


def test_journals_and_encoders_are_no_maps(encoder: pm.Encoder, tmp_path: Path) -> None:
    path = tmp_path / "scene.pmk"
    pm.PrototypeMap(encoder).save(path)
    with pm.open(path, journal=True) as scene:
        assert isinstance(scene, pm.PrototypeMap)
        scene.add_codes([1, 2], CODES)
    refused(lambda: pm.open(f"{path}.journal"), pm.FileError, "it is the journal of a map")
    refused(lambda: encoder.save(path), pm.FileError, "its journal holds 1 commits")
    encoder.save(tmp_path / "e.pme")
    refused(lambda: pm.open(tmp_path / "e.pme"), pm.FileError, "it holds an encoder, not a map")


def test_what_layers_would_lose_is_refused(encoder: pm.Encoder) -> None:
    def made(**changes: object) -> pm.Encoder:
        layers = encoder.layers
        layers[-1].update(changes)
        return pm.Encoder(layers, encoder.dims, "x", "x", 1.0)

    assert made().identity
    refused(lambda: made(shift=2**40), ValueError, "shift must be 1 to 62")
    refused(lambda: made(table=np.zeros(256, np.uint8)), ValueError, "last layer has no table")
    refused(lambda: made(weights=np.ones((2, 2, 1), np.int8)), TypeError, "weights: .* is needed")
    refused(lambda: pm.Encoder([3], [12], "x", "x", 1.0), TypeError, "must be a dict")  # type: ignore[list-item]


def test_names_at_the_limit_and_circles_of_links(encoder: pm.Encoder, tmp_path: Path) -> None:
    scene = pm.PrototypeMap(encoder)
    scene.save(tmp_path / ("n" * 255))
    assert len(pm.open(tmp_path / ("n" * 255))) == 0
    (tmp_path / "loop").symlink_to("loop")
    refused(lambda: scene.save(tmp_path / "loop"), pm.FileError, "symbolic links")
    assert (tmp_path / "loop").is_symlink()
