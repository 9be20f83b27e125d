"""Each measure against a case that was computed by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physhandi.metrics.geometry import (
    chamfer_one_way,
    chamfer_symmetric,
    dynamic_tracks,
    marker_error,
    nearest_distance,
    nearest_node,
    reprojection_error,
    rigid_follow_baseline,
    rigid_transform,
    static_baseline,
    track_error,
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


def test_empty_sets() -> None:
    assert np.isnan(chamfer_one_way(np.zeros((0, 3)), NODES))
    with pytest.raises(ValueError, match="no target"):
        chamfer_one_way(OBSERVED, np.zeros((0, 3)))
    assert nearest_node(np.zeros((0, 3)), NODES).shape == (0,)


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


def test_track_error_leaves_out_what_is_not_visible() -> None:
    rollout = np.zeros((3, 4, 3))
    point = np.zeros((3, 2, 3))
    point[1, 0] = [0, 3, 4]
    point[1, 1] = [0, 0, 1]
    point[2, 0] = np.nan
    is_visible = np.array([[True, True], [True, True], [False, False]])
    error = track_error(point, is_visible, rollout, np.array([1, 3]))
    assert error[:2].tolist() == [0.0, 3.0]
    assert np.isnan(error[2])


def test_marker_error_scores_the_given_markers_against_their_nodes() -> None:
    rollout = np.arange(2 * 5 * 3, dtype=float).reshape(2, 5, 3)
    marker = rollout[:, [0, 2, 4]] + np.array([[9.0, 9, 9], [0, 0, 2.0], [0, 6.0, 0]])
    error = marker_error(marker, rollout, np.array([0, 2, 4]), np.array([1, 2]))
    assert error == pytest.approx([4.0, 4.0])


def test_rigid_transform_recovers_a_motion() -> None:
    rng = np.random.default_rng(2)
    source = rng.normal(size=(20, 3))
    rotation = Rotation.from_rotvec([0.4, -1.2, 2.0]).as_matrix()
    target = source @ rotation.T + [1.0, 2.0, 3.0]
    found, translation = rigid_transform(source, target)
    assert found == pytest.approx(rotation)
    assert translation == pytest.approx([1, 2, 3])


def test_rigid_transform_never_mirrors() -> None:
    rng = np.random.default_rng(2)
    source = rng.normal(size=(20, 3))
    found, _ = rigid_transform(source, source * [1.0, 1.0, -1.0])
    expected, _ = Rotation.align_vectors(
        (source - source.mean(0)) * [1, 1, -1], source - source.mean(0)
    )
    assert np.linalg.det(found) == pytest.approx(1.0)
    assert found == pytest.approx(expected.as_matrix())


@pytest.mark.parametrize(
    ("direction", "expected"),
    [
        ([0.0, 1.0, 0.0], [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
        ([1.0, 0.0, 0.0], np.eye(3)),
    ],
)
def test_points_on_a_line_turn_as_little_as_possible(
    direction: list[float], expected: object
) -> None:
    step = np.linspace(-1, 2, 4)[:, None]
    found, _ = rigid_transform(step * [1.0, 0, 0], step * np.array(direction) + [5.0, 0, 0])
    assert found == pytest.approx(np.array(expected))


def test_a_reversed_line_turns_by_half_a_turn() -> None:
    step = np.linspace(-1, 2, 4)[:, None]
    found, _ = rigid_transform(step * [0.0, 0, 1], step * [0.0, 0, -1])
    assert np.linalg.det(found) == pytest.approx(1.0)
    assert found @ [0, 0, 1] == pytest.approx([0, 0, -1])


def test_one_point_only_moves() -> None:
    found, translation = rigid_transform(np.array([[1.0, 0, 0]]), np.array([[1.0, 2.0, 0]]))
    assert found == pytest.approx(np.eye(3))
    assert translation == pytest.approx([0, 2, 0])


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


def test_reprojection_error_leaves_out_lost_keypoints() -> None:
    projected = np.zeros((2, 3, 2))
    keypoint = np.array([[[3.0, 4.0, 1.0], [np.nan, np.nan, np.nan], [0, 1.0, 0.5]]] * 2)
    keypoint[1] = np.nan
    error = reprojection_error(projected, keypoint)
    assert error[0] == pytest.approx(3.0)
    assert np.isnan(error[1])
