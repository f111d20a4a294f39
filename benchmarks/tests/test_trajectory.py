import numpy as np
import pytest

from protomark_bench.trajectory import trajectory_error


def test_error_of_known_offsets():
    true = np.array([[0, 0, 0], [4, 0, 0], [4, 3, 0], [0, 3, 1.0]])
    error = trajectory_error(true, true)
    assert error.rmse == pytest.approx(0, abs=1e-12)
    assert error.poses == 4
    off = np.array([[0.1, 0, 0], [-0.1, 0, 0], [0, 0.1, 0], [0, -0.1, 0]])
    error = trajectory_error(true + off, true)
    assert error.median <= error.largest
    assert 0 < error.mean <= error.rmse <= 0.1 + 1e-9


@pytest.mark.parametrize(
    ("estimated", "true", "say"),
    [
        (np.zeros((2, 3)), np.zeros((2, 3)), "alignment needs three"),
        (np.zeros((5, 3)), np.ones((5, 3)), "same position"),
        (np.zeros((5, 3)), np.ones((4, 3)), "shape"),
    ],
)
def test_what_cannot_be_aligned(estimated, true, say):
    with pytest.raises(ValueError, match=say):
        trajectory_error(estimated, true)
