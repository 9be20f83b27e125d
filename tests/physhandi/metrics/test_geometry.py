"""Each distance against a case that was computed by hand, and against plain double loops."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from physhandi.metrics.geometry import (
    chamfer_one_way,
    chamfer_symmetric,
    dynamic_nodes,
    dynamic_tracks,
    marker_error,
    nearest_distance,
    nearest_node,
    track_error,
    track_error_phystwin,
)

OBSERVED = np.array([[0.0, 0, 0], [3.0, 4.0, 0]])
NODES = np.array([[0.0, 0, 1.0], [3.0, 0, 0], [100.0, 0, 0]])


def test_one_way_chamfer() -> None:
    # (0,0,0) is 1 from node 0; (3,4,0) is 4 from node 1. The far node does not count.
    assert chamfer_one_way(OBSERVED, NODES) == pytest.approx(2.5)
    assert chamfer_one_way(OBSERVED, NODES, "l1") == pytest.approx(2.5)
    diagonal = np.array([[1.0, 2.0, 2.0]])
    assert chamfer_one_way(diagonal, np.zeros((1, 3))) == pytest.approx(3.0)
    assert chamfer_one_way(diagonal, np.zeros((1, 3)), "l1") == pytest.approx(5.0)


def test_l1_chooses_its_own_neighbour() -> None:
    # By L2 the node (2,2,0) is nearer (2.83 < 3.5), by L1 the node (3.5,0,0) (3.5 < 4).
    nodes = np.array([[2.0, 2, 0], [3.5, 0, 0]])
    origin = np.zeros((1, 3))
    assert nearest_distance(origin, nodes)[0] == pytest.approx(8**0.5)
    assert nearest_distance(origin, nodes, "l1")[0] == pytest.approx(3.5)


def test_symmetric_chamfer_averages_both_directions() -> None:
    # Nodes to observed: 1, 3, and sqrt(97² + 4²).
    back = (1 + 3 + np.hypot(97, 4)) / 3
    assert chamfer_symmetric(OBSERVED, NODES) == pytest.approx((2.5 + back) / 2)
    assert chamfer_symmetric(NODES, OBSERVED) == pytest.approx((2.5 + back) / 2)


@pytest.mark.parametrize(("norm", "order"), [("l1", "cityblock"), ("l2", "euclidean")])
def test_chamfer_agrees_with_a_full_distance_matrix(norm, order) -> None:
    rng = np.random.default_rng(7)
    observed, nodes = rng.normal(size=(70, 3)), rng.normal(size=(40, 3))
    matrix = cdist(observed, nodes, order)
    there, back = (matrix.min(axis=axis).mean() for axis in (1, 0))
    assert chamfer_one_way(observed, nodes, norm) == pytest.approx(there)
    if norm == "l2":
        assert chamfer_symmetric(observed, nodes) == pytest.approx((there + back) / 2)
    assert matrix.min(axis=1).mean() != pytest.approx(matrix.min(axis=0).mean(), rel=0.01)


def test_empty_sets() -> None:
    nothing = np.zeros((0, 3))
    assert np.isnan(chamfer_one_way(nothing, NODES))
    assert np.isnan(chamfer_symmetric(nothing, NODES))
    assert np.isnan(chamfer_symmetric(NODES, nothing))
    with pytest.raises(ValueError, match="no target"):
        chamfer_one_way(OBSERVED, nothing)
    assert nearest_node(nothing, NODES).shape == (0,)


def test_a_point_is_dynamic_if_it_moves_in_any_frame() -> None:
    point = np.zeros((4, 5, 3))
    point[2, 0, 0] = 0.011  # Goes away and comes back.
    point[:, 1, 0] = [0, 0.003, 0.006, 0.009]  # Never far from frame 0.
    point[:, 2, 0] = [np.nan, 1.0, 1.0, 1.02]  # Seen from frame 1 on.
    point[3, 3] = np.nan
    point[3, 4, 2] = 0.5
    is_visible = np.isfinite(point).all(axis=2)
    is_visible[3, 4] = False  # What is not visible does not move.
    assert dynamic_tracks(point, is_visible).tolist() == [True, False, True, False, False]
    assert dynamic_tracks(point, is_visible, 0.008).tolist() == [True, True, True, False, False]


def test_the_threshold_is_the_papers_on_the_squared_norm() -> None:
    point = np.zeros((2, 2, 3))
    point[1] = np.array([[0.00575, 0.00575, 0.00575], [0.0058, 0.0058, 0.0058]])
    squared = (point[1] ** 2).sum(axis=1)
    assert squared.tolist() == pytest.approx([0.992e-4, 1.009e-4], rel=1e-3)
    assert dynamic_tracks(point, np.ones((2, 2), bool)).tolist() == (squared > 1e-4).tolist()


def test_nodes_are_dynamic_beside_a_dynamic_track() -> None:
    track = np.array([[0.0, 0, 0], [1.0, 0, 0], [np.nan] * 3])
    node = np.array([[0.1, 0, 0], [0.45, 0, 0], [0.55, 0, 0], [5.0, 0, 0]])
    is_dynamic = np.array([False, True, True])
    assert dynamic_nodes(node, track, is_dynamic).tolist() == [False, False, True, True]
    assert not dynamic_nodes(node, track[2:], is_dynamic[2:]).any()


def test_track_error_leaves_out_what_is_not_visible() -> None:
    point = np.zeros((3, 2, 3))
    point[1, 0] = [0, 3, 4]
    point[1, 1] = [0, 0, 1]
    point[2, 0] = np.nan
    is_visible = np.array([[True, True], [True, True], [False, False]])
    error = track_error(point, is_visible, np.zeros((3, 2, 3)))
    assert error[:2].tolist() == [0.0, 3.0]
    assert np.isnan(error[2])


def phystwin_by_loops(point: np.ndarray, vertices: np.ndarray) -> list[float]:
    """PhysTwin's definition, point by point: physics.md, section 5."""
    errors = []
    for frame in range(len(point)):
        distances = []
        for track in range(point.shape[1]):
            if np.isnan(point[0, track]).any() or np.isnan(point[frame, track]).any():
                continue
            gaps = [float(np.linalg.norm(point[0, track] - node)) for node in vertices[0]]
            node = gaps.index(min(gaps))
            distances.append(float(np.linalg.norm(point[frame, track] - vertices[frame, node])))
        errors.append(sum(distances) / len(distances) if distances else 0.0)
    return errors


def test_phystwins_track_error_agrees_with_plain_loops() -> None:
    rng = np.random.default_rng(3)
    rollout = rng.normal(size=(6, 9, 3)).cumsum(axis=0)
    point = rollout[:, [0, 4, 4, 7]] + rng.normal(scale=0.1, size=(6, 4, 3))
    point[rng.random((6, 4)) < 0.3] = np.nan
    point[0, 1], point[4] = np.nan, np.nan  # One track starts late, one frame shows nothing.
    is_visible = np.isfinite(point).all(axis=2)
    assert is_visible[1:, 1].any()
    error = track_error_phystwin(point, is_visible, rollout)
    assert error.tolist() == pytest.approx(phystwin_by_loops(point, rollout))
    assert error[4] == 0.0
    assert error[[1, 2, 3, 5]].min() > 0.01
    late = track_error_phystwin(point, is_visible, np.concatenate([rollout[:1], rollout[:-1]]))
    assert late[1:4].mean() > 3 * error[1:4].mean()


def test_phystwins_track_error_keeps_the_gap_of_frame_0() -> None:
    rollout = np.zeros((2, 1, 3))
    rollout[1, 0, 2] = 0.5
    point = rollout + np.array([0.03, 0.04, 0.0])
    visible = np.ones((2, 1), bool)
    assert track_error_phystwin(point, visible, rollout).tolist() == pytest.approx([0.05, 0.05])


def test_marker_error_scores_the_given_markers_against_their_nodes() -> None:
    rollout = np.arange(2 * 5 * 3, dtype=float).reshape(2, 5, 3)
    marker = rollout[:, [0, 2, 4]] + np.array([[9.0, 9, 9], [0, 0, 2.0], [0, 6.0, 0]])
    error = marker_error(marker, rollout, np.array([0, 2, 4]), np.array([1, 2]))
    assert error == pytest.approx([4.0, 4.0])
