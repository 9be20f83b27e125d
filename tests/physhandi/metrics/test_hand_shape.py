"""Errors of hands on cases computed by hand, and against SciPy."""

import numpy as np
import pytest
from scipy.spatial import procrustes
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from physhandi.metrics.hands import hand_chamfer, held_where_missing, joint_errors, vertex_errors


def random_joints(seed: int = 0, frames: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).normal(scale=0.05, size=(frames, 21, 3))


def test_hand_chamfer_by_hand() -> None:
    mesh = np.array([[[0.0, 0, 0], [1.0, 0, 0]]] * 3)
    points = (np.array([[0.0, 0, 0.5]]), np.zeros((0, 3)), np.array([[1.0, 0, 0], [1.0, 2.0, 0]]))
    curves = hand_chamfer(mesh, points)
    there, back = curves["chamfer_points_to_mesh"], curves["chamfer_mesh_to_points"]
    assert there[[0, 2]].tolist() == [0.5, 1.0]
    assert back[[0, 2]].tolist() == pytest.approx([(0.5 + np.hypot(1, 0.5)) / 2, 0.5])
    assert curves["chamfer_symmetric"][[0, 2]] == pytest.approx((there + back)[[0, 2]] / 2)
    assert np.isnan(curves["chamfer_symmetric"][1])


def test_hand_chamfer_agrees_with_a_full_distance_matrix_frame_by_frame() -> None:
    rng = np.random.default_rng(2)
    mesh, points = rng.normal(size=(3, 40, 3)), tuple(rng.normal(size=(n, 3)) for n in (9, 20, 5))
    found = hand_chamfer(mesh.astype(np.float32), points)["chamfer_symmetric"]
    for frame in range(3):
        matrix = cdist(mesh[frame], points[frame])
        both = [matrix.min(axis=axis).mean() for axis in (0, 1)]
        assert found[frame] == pytest.approx(np.mean(both), rel=1e-5)
    assert np.ptp(found) > 0.05


def test_a_shifted_hand_is_wrong_by_its_shift_only_in_the_world() -> None:
    true = random_joints()
    errors = joint_errors(true + np.array([0.003, 0.004, 0.0]), true)
    assert errors["mpjpe"].tolist() == pytest.approx([0.005] * 3)
    assert errors["mpjpe_wrist"] == pytest.approx(0.0, abs=1e-12)
    assert errors["mpjpe_procrustes"] == pytest.approx(0.0, abs=1e-12)


def test_a_hand_one_frame_late_is_wrong() -> None:
    true = np.arange(4)[:, None, None] * [0.01, 0.0, 0.0] + random_joints(frames=1)
    late = true[[0, 0, 1, 2]]
    assert joint_errors(late, true)["mpjpe"].tolist() == pytest.approx([0.0, 0.01, 0.01, 0.01])


def test_wrist_relative_error_by_hand() -> None:
    true = random_joints()
    fitted = true.copy()
    fitted[:, 0] += [0.0, 0.0, 0.021]  # Only the wrist is off, so all others are, seen from it.
    errors = joint_errors(fitted, true)
    assert errors["mpjpe"].tolist() == pytest.approx([0.001] * 3)
    assert errors["mpjpe_wrist"].tolist() == pytest.approx([0.020] * 3)


def test_aligned_errors_agree_with_scipys_procrustes() -> None:
    true = random_joints(1)
    fitted = 1.2 * (true + random_joints(2) * 0.1) @ Rotation.from_rotvec([0.5, 1, 0]).as_matrix()
    errors = joint_errors(fitted + 1.0, true)
    for frame in range(3):
        wanted, aligned, _ = procrustes(true[frame], fitted[frame])
        size = np.linalg.norm(true[frame] - true[frame].mean(0))
        expected = size * np.linalg.norm(wanted - aligned, axis=1).mean()
        assert errors["mpjpe_procrustes"][frame] == pytest.approx(expected)
    assert errors["mpjpe"].min() > 1.0
    assert 0.002 < errors["mpjpe_procrustes"].mean() < 0.02


def test_vertices_of_the_same_mesh_are_compared_one_by_one() -> None:
    joint = random_joints()
    true = np.random.default_rng(3).normal(size=(3, 50, 3))
    fitted = true + np.array([0.0, 0.0, 0.007])
    fitted[:, 1:2] += [0.0, 0.0, 0.05]
    errors = vertex_errors(fitted, true, joint, joint)
    assert errors["mpvpe"].tolist() == pytest.approx([0.008] * 3)
    assert errors["mpvpe_wrist"].tolist() == pytest.approx([0.008] * 3)
    assert 0 < errors["mpvpe_procrustes"].max() < 0.008
    moved = vertex_errors(fitted, true, joint + np.array([0.0, 0.0, 0.007]), joint)
    assert moved["mpvpe_wrist"].tolist() == pytest.approx([0.001] * 3)
    assert "mpvpe_wrist" not in vertex_errors(fitted, true)


def test_another_mesh_is_compared_as_a_surface() -> None:
    true = np.array([[[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]]])
    fitted = np.array([[[0.0, 0, 0.25], [1.0, 0, 0.25]]])
    errors = vertex_errors(fitted, true)
    assert set(errors) == {"surface_error"}
    back = (0.25 + 0.25 + np.hypot(1, 0.25)) / 3
    assert errors["surface_error"].tolist() == pytest.approx([(0.25 + back) / 2])


def test_a_hand_stands_still_where_its_fit_is_missing() -> None:
    motion = np.arange(5.0)[:, None, None] * np.ones((1, 2, 3))
    motion[[0, 3], 1] = np.nan
    held, missing = held_where_missing(motion)
    assert missing == 2
    assert held is not None
    assert held[:, 0, 0].tolist() == [1.0, 1.0, 2.0, 2.0, 4.0]
    assert held_where_missing(np.full((4, 2, 3), np.nan)) == (None, 4)
