"""What every hand model promises, held by the open hand and by MANO alike."""

from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
from torch import Tensor

from physhandi.hand.loading import load_hand_model
from physhandi.hand.model import HandModel, HandPose
from physhandi.hand.names import JOINT_NAMES, KEYPOINT_NAMES, HandKind
from physhandi.hand.open_hand import OpenHand

PALM_SIDE = {
    ("open", "right"): (-1.0, 0.0, 0.0),
    ("open", "left"): (1.0, 0.0, 0.0),
    ("mano", "right"): (0.0, -1.0, 0.0),
    ("mano", "left"): (0.0, -1.0, 0.0),
}
"""Where the palm looks in the template's frame."""


@pytest.fixture(params=get_args(HandKind))
def kind(request: pytest.FixtureRequest, mano: Path) -> HandKind:
    return request.param


@pytest.fixture(params=["right", "left"])
def hand(request: pytest.FixtureRequest, kind: HandKind) -> HandModel:
    return load_hand_model(request.param, kind)


def _pose(hand: HandModel, **changes: Tensor) -> HandPose:
    inputs = {
        "shape": torch.zeros(10, dtype=torch.float64),
        "articulation": torch.zeros(1, 15, 3, dtype=torch.float64),
        "wrist_rotation": torch.zeros(1, 3, dtype=torch.float64),
        "wrist_translation": torch.zeros(1, 3, dtype=torch.float64),
    }
    return hand(**{**inputs, **changes})


def _rotation(vector: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(vector)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def test_identity_pose_is_the_template(hand: HandModel) -> None:
    pose = _pose(hand)
    np.testing.assert_allclose(pose.vertex[0], hand.template, atol=1e-15)
    np.testing.assert_allclose(pose.keypoint[0], hand.keypoint_position, atol=1e-15)
    assert 0.17 < np.abs(hand.template).max() < 0.21


def test_counts_weights_and_faces_fit_together(hand: HandModel, kind: HandKind) -> None:
    assert (len(JOINT_NAMES), len(KEYPOINT_NAMES)) == (15, 21)
    assert (hand.shape_count, hand.joint_count) == (10, 15)
    assert (hand.kind, hand.vertex_count) == (kind, {"open": 1159, "mano": 778}[kind])
    assert len(hand.faces) == {"open": 2314, "mano": 1538}[kind]
    assert set(np.unique(hand.faces)) == set(range(hand.vertex_count))
    np.testing.assert_allclose(hand.weight.sum(1), 1, atol=1e-12)
    assert hand.weight.min() >= -1e-12
    assert hand.weight.shape == (hand.vertex_count, 16)


def test_faces_point_outwards(hand: HandModel) -> None:
    corner = hand.template[hand.faces] - hand.template.mean(0)
    volume = np.linalg.det(corner).sum() / 6
    assert volume == pytest.approx(340e-6, rel=0.1)


def test_joints_lie_in_their_fingers_and_axes_along_their_bones(hand: HandModel) -> None:
    bone = hand.bone_origins(torch.zeros(10, dtype=torch.float64)).numpy()
    np.testing.assert_allclose(bone[0], 0, atol=1e-15)
    np.testing.assert_allclose(bone[1:], hand.joint_position, atol=1e-15)
    tip = hand.keypoint_position[4::4]
    reach = np.linalg.norm(np.concatenate([bone[1:].reshape(5, 3, 3), tip[:, None]], 1), axis=-1)
    assert (np.diff(reach, axis=1) > 0.005).all()
    assert reach[2, 3] == reach[:, 3].max()
    for joint in range(15):
        axes = hand.joint_axes[joint]
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(axes) == pytest.approx(1)
        last = tip[joint // 3] if joint % 3 == 2 else bone[joint + 2]
        along = (last - bone[joint + 1]) / np.linalg.norm(last - bone[joint + 1])
        assert axes[:, 2] @ along < -0.8
        if joint >= 3:
            assert axes[:, 1] @ PALM_SIDE[hand.kind, hand.side] < -0.5


def test_negative_curl_closes_the_fist(hand: HandModel) -> None:
    articulation = torch.zeros(1, 15, 3, dtype=torch.float64)
    articulation[0, 3:, 0] = -1.2
    before, after = _pose(hand).keypoint[0], _pose(hand, articulation=articulation).keypoint[0]
    for tip in (8, 12, 16, 20):
        reach = [torch.linalg.norm(k[tip] - k[0]).item() for k in (before, after)]
        assert reach[1] < 0.65 * reach[0]
        palm = np.array(PALM_SIDE[hand.kind, hand.side])
        assert (after - before)[tip].numpy() @ palm > 0.015


def test_wrist_turns_and_scale_multiplies_everything(hand: HandModel) -> None:
    rotation, translation = np.array([0.3, -0.5, 0.9]), np.array([1.0, 2.0, 3.0])
    pose = hand(
        torch.zeros(10, dtype=torch.float64),
        torch.zeros(1, 15, 3, dtype=torch.float64),
        torch.from_numpy(rotation)[None],
        torch.from_numpy(translation)[None],
        2.0,
    )
    for found, still in (
        (pose.vertex, hand.template),
        (pose.keypoint, hand.keypoint_position),
    ):
        expected = 2 * (still @ _rotation(rotation).T + translation)
        np.testing.assert_allclose(found[0].numpy(), expected, atol=1e-12)


def test_a_joints_keypoint_stays_when_the_joint_turns_but_a_tips_does_not(kind: HandKind) -> None:
    hand = load_hand_model("right", kind)
    articulation = torch.zeros(1, 15, 3, dtype=torch.float64)
    articulation[0, JOINT_NAMES.index("ring_dip"), 0] = -0.8
    moved = (_pose(hand, articulation=articulation).keypoint - _pose(hand).keypoint).norm(dim=-1)[0]
    tips = [4, 8, 12, 20]
    assert moved[16] > 0.008
    assert np.delete(moved.numpy(), [*tips, 16]).max() < 1e-15
    # MANO's pose blend shapes bulge every vertex a little, the other tips too.
    assert moved[tips].max() < {"open": 1e-15, "mano": 2e-3}[kind]


def test_left_hand_is_the_mirrored_right_hand(kind: HandKind) -> None:
    random = torch.Generator().manual_seed(0)
    right, left = load_hand_model("right", kind), load_hand_model("left", kind)
    shape = torch.randn(10, generator=random, dtype=torch.float64)
    articulation = 0.4 * torch.randn(3, 15, 3, generator=random, dtype=torch.float64)
    rotation = torch.randn(3, 3, generator=random, dtype=torch.float64)
    translation = torch.randn(3, 3, generator=random, dtype=torch.float64)
    mirror, turn = torch.tensor([-1.0, 1, 1]).double(), torch.tensor([1.0, -1, -1]).double()
    ours = right(shape, articulation, rotation, translation)
    mirrored = left(shape, articulation * turn, rotation * turn, translation * mirror)
    np.testing.assert_allclose(mirrored.vertex, ours.vertex * mirror, atol=1e-9)
    np.testing.assert_allclose(mirrored.keypoint, ours.keypoint * mirror, atol=1e-9)
    only_keypoints = right.keypoints(shape, articulation, rotation, translation)
    assert torch.equal(only_keypoints, ours.keypoint)


def test_gradient_is_that_of_finite_differences(kind: HandKind) -> None:
    hand = load_hand_model("right", kind)
    random = torch.Generator().manual_seed(1)

    def draw(*size: int) -> Tensor:
        return 0.3 * torch.randn(size, generator=random, dtype=torch.float64)

    inputs = [draw(10), draw(2, 15, 3), draw(2, 3), draw(2, 3), torch.tensor(1.3).double()]
    inputs[1][0, 4] = 0.0
    vertex_weight, keypoint_weight = draw(2, hand.vertex_count, 3), draw(2, 21, 3)

    def loss(*values: Tensor) -> Tensor:
        pose = hand(*values)
        return (pose.vertex * vertex_weight).sum() + (pose.keypoint * keypoint_weight).sum()

    for value in inputs:
        value.requires_grad_()
    loss(*inputs).backward()
    for position, value in enumerate(inputs):
        gradient = value.grad
        assert gradient is not None
        direction = draw(*value.shape)
        step = 1e-6
        with torch.no_grad():
            shifted = [
                loss(
                    *(
                        v + sign * step * direction if i == position else v
                        for i, v in enumerate(inputs)
                    )
                )
                for sign in (1, -1)
            ]
        expected = ((shifted[0] - shifted[1]) / (2 * step)).item()
        assert abs(expected) > 1e-4
        assert (gradient * direction).sum().item() == pytest.approx(expected, rel=1e-6)


def test_single_precision_agrees_with_double(kind: HandKind) -> None:
    hand = load_hand_model("right", kind)
    random = torch.Generator().manual_seed(2)
    inputs = [
        0.3 * torch.randn(size, generator=random, dtype=torch.float64)
        for size in ((10,), (2, 15, 3), (2, 3), (2, 3))
    ]
    double, single = hand(*inputs), hand(*(value.float() for value in inputs))
    assert single.vertex.dtype == torch.float32
    np.testing.assert_allclose(single.vertex, double.vertex, atol=1e-6)


def test_model_is_loaded_once_and_knows_its_side(kind: HandKind) -> None:
    assert load_hand_model("right", kind) is load_hand_model("right", kind)
    assert load_hand_model("left", kind).side == "left"
    assert isinstance(load_hand_model("left"), OpenHand)
