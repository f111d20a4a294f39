from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

import protomark as pm
from protomark import sample
from protomark.cli import app
from protomark.features.upright import BYTES, upright_descriptors
from protomark.maps.build import build_map


def added(angle: float, size: float) -> tuple[list[int], list[int]]:
    """The set bits of the 32 angle bits and of the 32 size bits."""
    longer = upright_descriptors(np.zeros((1, 4), np.uint8), [angle], [size])
    bits = np.unpackbits(longer[0, 4:], bitorder="little")
    return np.flatnonzero(bits[:32]).tolist(), np.flatnonzero(bits[32:]).tolist()


def test_angle_sets_its_step_and_three_on_either_side_around_the_circle():
    assert added(180.0, 0)[0] == [13, 14, 15, 16, 17, 18, 19]
    assert added(0.0, 0)[0] == [0, 1, 2, 3, 29, 30, 31]
    assert added(359.999, 0)[0] == [0, 1, 2, 28, 29, 30, 31]


def test_size_sets_its_quarter_octave_and_two_on_either_side():
    assert added(-1, 12.0)[1] == [2, 3, 4, 5, 6]
    assert added(-1, 1.0)[1] == [0, 1, 2]
    assert added(-1, 1e6)[1] == [29, 30, 31]


@pytest.mark.parametrize("value", [-1.0, np.nan, -np.inf])
def test_unknown_sets_nothing(value):
    assert added(value, value) == ([], [])


@given(st.floats(0, 359.9), st.floats(0, 359.9), st.floats(-360, 360))
def test_only_the_difference_of_angles_counts_up_to_a_step(a, b, turn):
    def distance(x, y):
        return len(set(added(x, 0)[0]) ^ set(added(y, 0)[0]))

    turned = distance((a + turn) % 360, (b + turn) % 360)
    assert abs(distance(a, b) - turned) <= 2


def test_descriptors_stay_and_shapes_must_fit():
    rng = np.random.default_rng(0)
    descriptors = rng.integers(0, 256, (7, 64), np.uint8)
    longer = pm.upright_descriptors(descriptors, rng.uniform(0, 360, 7), rng.uniform(5, 50, 7))
    assert longer.shape == (7, 64 + BYTES)
    np.testing.assert_array_equal(longer[:, :64], descriptors)
    with pytest.raises(ValueError, match="do not fit together"):
        pm.upright_descriptors(descriptors, np.zeros(6), np.zeros(7))


def test_tracks_without_angles_are_refused():
    tracks = sample.load()
    assert tracks.upright().descriptor == "freak-upright"
    assert tracks.upright().bits == tracks.bits + 8 * BYTES
    tracks.angles = np.full_like(tracks.angles, -1)
    with pytest.raises(ValueError, match="no keypoint of these freak tracks has an angle"):
        tracks.upright()


def test_evaluate_gives_only_our_methods_the_longer_descriptors(tmp_path):
    from conftest import random_layers

    tracks = sample.load()
    encoder = pm.Encoder(
        random_layers([576, 32, 16]), [16], name="u", descriptor="freak-upright", scale=0.02
    )
    encoder.save(tmp_path / "u.pme")
    words = ["evaluate", str(sample.path()), "--encoder", str(tmp_path / "u.pme"), "--seeds", "1"]
    words += ["--methods", "medoid,protomark-16", "--pose-frames", "2"]
    done = CliRunner().invoke(app, [*words, "--json", str(tmp_path / "u.json")])
    assert done.exit_code == 0, done.output
    (result,) = json.loads((tmp_path / "u.json").read_text())["sequences"]
    medoid, ours = result["methods"]
    assert result["descriptor"] == tracks.descriptor
    assert medoid["bytes_per_landmark"] == [64]
    assert ours["precision"][0] > 0.05

    # `build` finds by itself that the encoder needs angles and sizes.
    assert build_map(tracks, encoder).encoder.descriptor == "freak-upright"
