"""Choosing control points and laying a known object into another sequence."""

import numpy as np
from scipy.spatial.transform import Rotation

from physhandi.fitting.placement import farthest_points, lay_object


def test_farthest_points_spread() -> None:
    line = np.array([[0, 0, 0], [0.1, 0, 0], [1, 0, 0], [0.5, 0, 0]], float)
    assert farthest_points(line, 3).tolist() == [0, 2, 3]
    assert sorted(farthest_points(line, 9)) == [0, 1, 2, 3]


def test_a_turned_object_is_found_again() -> None:
    random = np.random.default_rng(0)
    template = np.stack(
        [random.uniform(0, 0.3, 300), random.uniform(0, 0.1, 300), np.zeros(300)], axis=1
    )
    template[:, 2] = 0.05 * (template[:, 0] > 0.2)
    turn = Rotation.from_euler("zyx", [2.0, 0.1, -0.05])
    expected = turn.apply(template) + np.array([0.4, -0.2, 0.1])
    cloud = expected[random.permutation(300)[:200]] + random.normal(0, 1e-4, (200, 3))
    laid = lay_object(template.astype(np.float32), cloud)
    assert np.linalg.norm(laid - expected, axis=1).mean() < 2e-3
    assert np.linalg.norm(template - expected, axis=1).mean() > 0.2
