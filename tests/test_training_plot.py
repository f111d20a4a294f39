from __future__ import annotations

import pytest

from protomark.plot import save_figure, training_figure


@pytest.mark.parametrize(("suffix", "start"), [("png", b"\x89PNG"), ("svg", b"<?xml")])
def test_figure_is_a_picture_and_replaces_the_last_one(tmp_path, suffix, start):
    path = tmp_path / f"mine.{suffix}"
    save_figure(training_figure([100], [2.0], {8: [0.25], 16: [0.5]}, None), path)
    first = path.read_bytes()
    both = training_figure([100, 200], [2.0, 1.0], {8: [0.2, 0.3], 16: [0.5, 0.7]}, 200, "mine")
    save_figure(both, path)
    assert path.read_bytes().startswith(start)
    assert path.read_bytes() != first
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
