"""The terms of stage 1 against closed forms."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from support.physics import hand_scene as scene

from physhandi.data.camera import PinholeCamera, triangulate
from physhandi.fitting.hands.losses import (
    JOINT_LIMIT,
    depth_loss,
    free_space_loss,
    hand_acceleration_loss,
    limit_loss,
    reprojection_loss,
    velocity_loss,
    vertex_normals_torch,
)
from physhandi.fitting.hands.observed import DepthTarget, FreeSpace, free_space, keypoint_target
from physhandi.hand.loading import load_hand_model


def _camera(x: float, distortion: float = 0.0) -> PinholeCamera:
    pose = np.eye(4)
    pose[0, 3] = x
    return PinholeCamera(
        K=np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]),
        T_world_camera=pose,
        width=100,
        height=100,
        distortion=np.array([distortion, 0, 0, 0, 0]),
    )


def test_reprojection_is_cauchys_loss_of_the_distance() -> None:
    point = np.zeros((2, 21, 3))
    point[..., 0] = np.linspace(-0.3, 0.3, 21)
    point[..., 2] = 2.0
    camera = _camera(0.1, distortion=0.2)
    seen = np.concatenate([camera.project(point), np.full((2, 21, 1), 0.5)], -1)
    target = keypoint_target([camera], seen[None], relative_noise=0.1)
    noise = float(target.noise[0])
    assert noise == pytest.approx(0.1 * np.ptp(seen[0, :, 0]))
    at_truth = reprojection_loss(torch.tensor(point, dtype=torch.float32), target, 2.0)
    assert float(at_truth) < 1e-6
    shifted = torch.tensor(point + np.array([0, 0.06, 0]), dtype=torch.float32)
    distance = 3.0 / noise
    expected = 0.5 * 21 * 4 * math.log1p(distance**2 / 4)
    assert float(reprojection_loss(shifted, target, 2.0)) == pytest.approx(expected, rel=0.03)
    unseen = keypoint_target([camera], np.full_like(seen[None], np.nan), relative_noise=0.1)
    assert float(reprojection_loss(shifted, unseen, 2.0)) == 0


def test_limits_cost_the_square_of_the_excess_on_both_sides() -> None:
    for side, sign in (("right", 1.0), ("left", -1.0)):
        articulation = torch.zeros(2, 15, 3)
        articulation[0, 4, 0] = float(JOINT_LIMIT[4, 0, 1]) + 0.3
        articulation[1, 3, 1] = sign * (float(JOINT_LIMIT[3, 1, 0]) - 0.1)
        cost = float(limit_loss(articulation, load_hand_model(side)))
        assert cost == pytest.approx((0.09 + 0.01) / 2, rel=1e-4)
    assert float(limit_loss(torch.zeros(1, 15, 3), load_hand_model("right"))) == 0


def test_smoothness_is_the_square_of_differences() -> None:
    time = torch.arange(5.0)[:, None, None]
    falling = (0.5 * 0.2 * time**2).expand(5, 21, 3)
    assert float(hand_acceleration_loss(falling)) == pytest.approx(3 * 21 * 3 * 0.04 / 5, rel=1e-4)
    assert float(hand_acceleration_loss(falling[:2])) == 0
    even = (0.1 * time).expand(5, 15, 3)
    assert float(velocity_loss(even)) == pytest.approx(4 * 15 * 3 * 0.01 / 5, rel=1e-4)


def test_normals_of_a_hand_have_length_one_and_point_outwards() -> None:
    hand = load_hand_model("left")
    zero = torch.zeros(1, 3, dtype=torch.float64)
    vertex = hand(zero.new_zeros(10), zero.new_zeros(1, 15, 3), zero, zero).vertex
    normal = vertex_normals_torch(vertex, torch.from_numpy(hand.faces))
    np.testing.assert_allclose(normal.norm(dim=-1), 1, atol=1e-9)
    swollen = vertex + 1e-3 * normal
    assert (
        torch.linalg.norm(swollen - vertex.mean(1), dim=-1).mean()
        > torch.linalg.norm(vertex - vertex.mean(1), dim=-1).mean()
    )


def test_depth_chooses_the_side_that_faces_the_camera() -> None:
    low, high = 0.0, 0.004
    grid = torch.tensor([[x, y] for x in range(6) for y in range(6)]) * 0.01
    quads = [(6 * x + y, 6 * x + y + 1, 6 * x + y + 7) for x in range(5) for y in range(5)]
    quads += [(6 * x + y, 6 * x + y + 7, 6 * x + y + 6) for x in range(5) for y in range(5)]
    down = torch.tensor(quads)
    up = down[:, [0, 2, 1]] + 36
    bottom = torch.cat([grid, torch.full((36, 1), low)], 1)
    top = torch.cat([grid, torch.full((36, 1), high)], 1)
    vertex = torch.cat([bottom, top])[None]
    point = torch.tensor([[[0.02, 0.02, 0.001], [0.03, 0.03, 0.001]]])
    target = DepthTarget(
        point=point,
        towards_camera=torch.tensor([[[0.0, 0, 1], [0, 0, 1]]]),
        weight=torch.full((1, 2), 0.5),
    )
    cost = float(depth_loss(vertex, torch.cat([down, up]), target, noise=0.003))
    assert target.vertex is not None
    assert (target.vertex >= 36).all()
    assert cost == pytest.approx(9 * math.log1p(1 / 9), rel=1e-4)


def test_triangulation_returns_the_point_or_nothing() -> None:
    cameras = [_camera(0.0, 0.1), _camera(0.4, -0.05), _camera(0.001)]
    truth = np.array([[0.1, -0.2, 1.5], [0.3, 0.1, 2.0], [0.0, 0.0, 1.0], [0.2, 0.2, 1.2]])
    pixel = np.stack([camera.project(truth) for camera in cameras])
    pixel[2, [0, 3]] = np.nan
    pixel[1, 1] = np.nan
    pixel[1:, 2] = np.nan
    pixel[1, 3, 1] += 30
    weight = np.ones((3, 4))
    point = triangulate(cameras, pixel, weight, tolerance=5.0)
    np.testing.assert_allclose(point[0], truth[0], atol=1e-6)
    assert np.isnan(point[1]).all(), "the two views that see it stand side by side"
    assert np.isnan(point[2]).all(), "only one view sees it"
    assert np.isnan(point[3]).all(), "the views disagree"
    assert np.isnan(triangulate(cameras[:1], pixel[:1], weight[:1], 5.0)).all()


def _space(depth: float) -> FreeSpace:
    """A camera at the origin that measured one depth to the left, and nothing to the right."""
    measured = torch.zeros(1, 2, 64, 64)
    measured[..., :32] = depth
    projection = torch.tensor([[[100.0, 0, 50, 0], [0, 100, 50, 0], [0, 0, 1, 0]]])
    return FreeSpace(measured, torch.zeros(1, 2, 2), torch.full((1, 2), 100 / 63), projection)


def test_keypoints_cost_where_a_camera_looked_through_them_and_nowhere_else() -> None:
    point = torch.zeros(2, 21, 3)
    point[..., 0], point[..., 2] = -0.2, 1.1
    space = _space(1.0)
    assert float(free_space_loss(point, space, 0.004)) == 0  # Hidden by the surface.
    point[0, 3, 2] = 0.995
    point.requires_grad_()
    loss = free_space_loss(point, space, 0.004)
    expected = 9 * math.log1p((0.008 / 0.004) ** 2 / 9) / 2
    assert float(loss.detach()) == pytest.approx(expected, rel=1e-3)
    (gradient,) = torch.autograd.grad(loss, point)
    assert float(gradient[0, 3, 2]) < 0  # Farther away is better.
    with torch.no_grad():
        gradient[0, 3] = 0
        assert not gradient.any()
        for place in ([0.2, 0.0, 0.995], [-0.2, 0.0, 0.9], [-0.9, 0.0, 0.995]):
            # Nothing was measured there; before another thing's edge; out of what was read.
            point[0, 3] = torch.tensor(place)
            assert float(free_space_loss(point, space, 0.004)) == 0


def test_free_space_is_read_around_the_keypoints_through_the_lens(tmp_path: Path) -> None:
    truth, camera = scene.grasping(frames=2), scene.looking_at_hand(0.0)
    keypoint = scene.seen_keypoints([truth], [camera])
    keypoint[0, 1] = np.nan
    sequence = scene.write_scene(tmp_path / "a", [truth], [camera], keypoint, depth=True)
    space = free_space(sequence.views, keypoint_target([camera], keypoint[:, :, 0], 0.015))
    assert not space.depth[0, 1].any()  # Nobody knows where the hand is.
    vertex = truth.vertices(load_hand_model("right"))[0].astype(np.float64)
    cell = camera.undistort(camera.project(vertex)) - space.corner[0, 0].numpy()
    column, row = np.round(cell / float(space.step[0, 0])).astype(int).T
    assert min(column.min(), row.min()) >= 0
    assert max(column.max(), row.max()) < 64
    behind = camera.camera_depth(vertex) - space.depth[0, 0].numpy()[row, column]
    assert np.quantile(np.abs(behind), 0.3) < 0.003  # The side that is seen.
    assert np.quantile(behind, 0.05) > -0.006  # Nothing of the hand is before what was measured.
