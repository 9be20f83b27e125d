"""Choosing control points."""

import numpy as np

from physhandi.fitting.placement import farthest_points


def test_farthest_points_spread() -> None:
    line = np.array([[0, 0, 0], [0.1, 0, 0], [1, 0, 0], [0.5, 0, 0]], float)
    assert farthest_points(line, 3).tolist() == [0, 2, 3]
    assert sorted(farthest_points(line, 9)) == [0, 1, 2, 3]
