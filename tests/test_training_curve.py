from __future__ import annotations

import pytest

from protomark.training.curve import save_curve, sparkline
from protomark.training.train import Progress


def progress(step: int, loss: float, precision: float, quantized: bool = False) -> Progress:
    return Progress(step, 400, loss, {8: precision / 2, 16: precision}, quantized, 1.0)


def test_sparkline_runs_from_the_least_to_the_greatest():
    assert sparkline([]) == ""
    assert sparkline([3.0]) == "▁"
    assert sparkline([1.0, 1.0, 1.0]) == "▁▁▁"
    assert sparkline([4, 3, 2, 1]) == "█▆▃▁"
    many = sparkline([float(i) for i in range(1000)], width=20)
    assert len(many) == 20
    assert list(many) == sorted(many)
    assert many[0] == "▁"
    assert many[-1] == "█"


@pytest.mark.parametrize(("ending", "start"), [("png", b"\x89PNG"), ("svg", b"<?xml")])
def test_curve_is_a_picture_and_replaces_the_last_one(tmp_path, ending, start):
    path = tmp_path / f"mine.{ending}"
    save_curve([progress(100, 2.0, 0.5)], path)
    first = path.read_bytes()
    save_curve([progress(100, 2.0, 0.5), progress(200, 1.0, 0.7, True)], path, "mine")
    assert path.read_bytes().startswith(start)
    assert path.read_bytes() != first
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_nothing_to_draw_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="no validation"):
        save_curve([], tmp_path / "mine.png")
