"""The baselines on a motion that can be worked out on paper."""

import numpy as np
import pytest

from physhandi.metrics.baselines import (
    last_residual_baseline,
    rigid_follow_baseline,
    static_baseline,
)


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


NODE = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.0, 1, 0], [5.0, 0, 0], [6.0, 0, 0], [5.0, 1, 0]])
RISE = np.arange(4.0)[:, None, None] * np.array([0.0, 0, 0.25])
ROLLOUT = NODE + RISE


def corrected(point: np.ndarray, seen: np.ndarray, **more: object) -> np.ndarray:
    return last_residual_baseline(ROLLOUT, point, seen, 3, **more)  # type: ignore[arg-type]


def test_the_last_residual_shifts_the_future_by_what_frame_2_missed() -> None:
    point = ROLLOUT + np.arange(4.0)[:, None, None] * np.array([0.1, 0, -0.2])
    seen = np.ones((4, 6), bool)
    for node_of_track in (None, np.arange(6)):
        found = corrected(point, seen, node_of_track=node_of_track)
        np.testing.assert_allclose(found[:3], ROLLOUT[:3], atol=1e-12)
        np.testing.assert_allclose(found[3], ROLLOUT[3] + [0.2, 0, -0.4], atol=1e-9)


def test_future_observations_do_not_enter_the_last_residual() -> None:
    point, seen = ROLLOUT + 0.5, np.ones((4, 6), bool)
    other = point.copy()
    other[3] += 100.0
    np.testing.assert_array_equal(corrected(point, seen), corrected(other, seen))


def test_each_node_takes_the_residual_of_the_tracks_beside_it() -> None:
    point, seen = ROLLOUT.copy(), np.ones((4, 6), bool)
    point[2, 3:, 2] += 0.4
    seen[2, 1] = False
    point[2, 1] = np.nan
    found = corrected(point, seen, node_of_track=np.arange(6))
    shift = found[3, :, 2] - ROLLOUT[3, :, 2]
    assert shift[0] == pytest.approx(0.0, abs=1e-3)
    assert shift[4] == pytest.approx(0.4, abs=1e-3)
    assert 0.0 < shift[1] < 0.2


def test_where_nothing_was_seen_there_is_no_residual() -> None:
    seen = np.ones((4, 6), bool)
    seen[2] = False
    with pytest.raises(ValueError, match="frame 2 shows no track"):
        corrected(ROLLOUT, seen)
    with pytest.raises(ValueError, match="first_future is 0"):
        last_residual_baseline(ROLLOUT, ROLLOUT, np.ones((4, 6), bool), 0)
