"""Scripts that compute figures of docs/, on small data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import index_recall
import protomark as pm
import tracks_table
from localization_halves import calibrated, kinds_of_map, localize_halves
from protomark import sample
from protomark.tracks import Tracks


@pytest.fixture(scope="module")
def tracks() -> Tracks:
    return Tracks.load(sample.path())


@pytest.fixture(scope="module")
def encoder() -> pm.Encoder:
    return pm.Encoder.load("freak")


def test_halves_of_the_sample(tracks: Tracks, encoder: pm.Encoder) -> None:
    kinds = kinds_of_map(encoder, [32])
    assert list(kinds) == ["all descriptors", "medoid", "prototypes, 32"]
    one, ours = (
        localize_halves(tracks, build, calibrated(build, [tracks], 3), share=0.8, stride=6)
        for build in (kinds["medoid"], kinds["prototypes, 32"])
    )
    assert one.frames == ours.frames == 3
    assert (one.bytes_per_landmark, ours.bytes_per_landmark) == (64, 33)
    assert one.landmarks == ours.landmarks
    assert ours.recall[-1] >= one.recall[-1] > 0


def test_recall_of_the_sample(tracks: Tracks, encoder: pm.Encoder) -> None:
    sequence = index_recall.read(tracks, encoder, 32, 0)
    scene = pm.PrototypeMap(encoder, 32)
    scene.add_codes(sequence.landmarks, sequence.codes)
    scene.build_index()
    least = index_recall.least_nprobe(scene, sequence.frames, 0.95)
    assert index_recall.recall(scene, sequence.frames, None, least) >= 0.95
    assert least == 1 or index_recall.recall(scene, sequence.frames, None, least - 1) < 0.95
    assert 0.1 < sequence.spread < 0.6


def test_spread_is_that_of_the_definition() -> None:
    codes = np.array([[0, 0], [2, 0], [1, 3], [5, 5], [9, 9], [7, 4]], np.int8)
    landmarks = np.array([4, 4, 4, 8, 8, 8])
    expected = []
    for i in range(6):
        others = [j for j in range(6) if j != i and landmarks[j] == landmarks[i]]
        expected.append(np.square(codes[i] - codes[others].mean(0)).sum())
    variance = np.array([codes[:3].mean(0), codes[3:].mean(0)]).var(0).sum()
    order = np.array([3, 0, 4, 1, 5, 2])
    empty = np.zeros((0, 2), np.int8)
    sequence = index_recall.CodedSequence(landmarks[order], codes[order], empty, empty)
    assert sequence.spread == pytest.approx(np.mean(expected) / variance)


def test_table_of_tracks() -> None:
    (row,) = tracks_table.table([Path(sample.path())]).rows
    assert row[:2] == ["freak", "toy"]
    assert len(row) == len(tracks_table.HEADS)


def test_service_speed_on_the_sample(tmp_path: Path) -> None:
    pytest.importorskip("fastapi_offline")
    import service_speed

    path = tmp_path / "sample.pmk"
    requests = service_speed.sample_requests(path)[::20]
    with service_speed.served(path, ["--threads", "1"]) as address:
        (*closed, rate) = service_speed.measure(address, requests, 0.5, [4.0])
    assert [row[0] for row in closed] == ["1 client", "2 clients", "4 clients"]
    assert rate[-1] == "2 of 2"
