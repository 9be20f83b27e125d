"""The baselines on a motion that can be worked out on paper."""

import numpy as np
import pytest

from physhandi.metrics.baselines import rigid_follow_baseline, static_baseline


def test_baselines() -> None:
    node = np.array([[0.0, 0, 0], [2.0, 0, 0]])
    still = static_baseline(node, 3)
    assert still.shape == (3, 2, 3)
    assert still[2].tolist() == node.tolist()
    # The controls turn by 90 degrees about z around (1,0,0) and rise by 5.
    control = np.array([[[1.0, 1, 0], [2.0, 0, 0], [1.0, 0, 1.0]]] * 2)
    control[1] = [[0.0, 0, 5], [1.0, 1, 5], [1.0, 0, 6.0]]
    moved = rigid_follow_baseline(node, control)
    assert moved[0] == pytest.approx(node)
    assert moved[1] == pytest.approx(np.array([[1.0, -1, 5], [1.0, 1, 5]]))
