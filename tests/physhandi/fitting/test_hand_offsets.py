"""Corrections of a hand: composed, carried, and stepped as they say."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from support.physics.hand_scene import grasping

from physhandi.adam import Adam
from physhandi.fitting.hand_refinement import HandOffsets, OffsetDescent, control_nodes
from physhandi.hand.loading import load_hand_model

RATES = {"articulation": 0.01, "rotation": 0.02, "translation": 1e-3}


def offsets(frames: int = 5, fitted: int = 3, **changes: object) -> HandOffsets:
    motion = replace(grasping(frames=frames), **changes)
    return HandOffsets(motion, load_hand_model("right"), fitted)


def drawn(hand: HandOffsets, seed: int = 0) -> dict[str, torch.Tensor]:
    random = np.random.default_rng(seed)
    return {
        name: torch.tensor(random.normal(0, 0.05, value.shape), dtype=torch.float32)
        for name, value in hand.value.items()
    }


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_the_pose_that_is_differentiated_is_the_motion_that_is_stored(scale: float) -> None:
    hand = offsets(scale=scale)
    hand.restore(drawn(hand))
    pose, motion = hand.pose(), hand.motion(carried=2.0)
    model = load_hand_model("right")
    np.testing.assert_allclose(pose.vertex.detach(), motion.vertices(model)[:3], atol=2e-6)
    np.testing.assert_allclose(pose.keypoint.detach(), motion.keypoints(model)[:3], atol=2e-6)
    gap = hand.displacement(pose).detach().numpy()
    expected = motion.vertices(model) - hand.before.vertices(model)
    np.testing.assert_allclose(gap, expected[:3], atol=4e-6)
    assert np.abs(gap).max() > 0.01


def test_no_correction_is_the_motion_itself() -> None:
    hand = offsets()
    same = hand.motion(carried=2.0)
    for name in ("articulation", "wrist_rotation", "wrist_translation"):
        np.testing.assert_allclose(getattr(same, name), getattr(hand.before, name), atol=2e-7)
    model = load_hand_model("right")
    np.testing.assert_allclose(
        hand.pose().vertex.detach(), hand.before.vertices(model)[:3], atol=1e-6
    )


def test_the_wrist_turns_in_the_frame_of_the_hand() -> None:
    hand = offsets()
    turn = np.array([0.1, -0.2, 0.05])
    offset = hand.copy()
    offset["rotation"][1] = torch.tensor(turn)
    hand.restore(offset)
    before = Rotation.from_rotvec(hand.before.wrist_rotation)
    after = Rotation.from_rotvec(hand.motion(carried=0.0).wrist_rotation)
    found = (before.inv() * after).as_rotvec()
    np.testing.assert_allclose(found[1], turn, atol=1e-6)
    np.testing.assert_allclose(found[[0, 2, 3, 4]], 0, atol=1e-6)


def test_a_turn_beyond_half_a_circle_stays_next_to_what_it_was() -> None:
    rotation = np.tile([0.0, 3.1, 0.0], (5, 1))
    hand = offsets(wrist_rotation=rotation)
    offset = hand.copy()
    offset["rotation"][:] = torch.tensor([0.0, 0.2, 0.0])
    hand.restore(offset)
    np.testing.assert_allclose(
        hand.motion(carried=1e9).wrist_rotation, rotation + np.array([0, 0.2, 0]), atol=1e-5
    )


def test_what_is_carried_fades_and_nothing_is_carried_if_not_asked_for() -> None:
    hand = offsets()
    hand.restore(drawn(hand))
    last = hand.value["articulation"].detach().numpy()[-1]
    carried = hand.motion(carried=2.0).articulation - hand.before.articulation
    np.testing.assert_allclose(carried[3], last * np.exp(-0.5), atol=1e-6)
    np.testing.assert_allclose(carried[4], last * np.exp(-1.0), atol=1e-6)
    none = hand.motion(carried=0.0).articulation - hand.before.articulation
    np.testing.assert_allclose(none[3:], 0.0, atol=1e-7)
    assert np.abs(last).max() > 0.05


def gradients(hand: HandOffsets, seed: int) -> None:
    random = np.random.default_rng(seed)
    for value in hand.value.values():
        value.grad = torch.tensor(random.normal(size=value.shape), dtype=torch.float32)


def test_by_parameter_it_is_adam() -> None:
    hand = offsets()
    names = list(hand.value)
    twins = {name: torch.zeros_like(hand.value[name], requires_grad=True) for name in names}
    rates = [(twins[name], RATES[name]) for name in names]
    adam = Adam(rates, betas=(0.9, 0.99), epsilon=1e-12)
    descent = OffsetDescent(hand, RATES, 0.99, by_parameter=True)
    for seed in range(4):
        gradients(hand, seed)
        for name in names:
            twins[name].grad = hand.value[name].grad.clone()
        descent.step(1.0)
        adam.step()
    for name in names:
        np.testing.assert_allclose(
            hand.value[name].detach(), twins[name].detach(), rtol=2e-5, atol=1e-8
        )
        assert float(hand.value[name].detach().abs().max()) > RATES[name]


def test_together_a_frame_takes_one_step_along_its_gradient() -> None:
    hand = offsets()
    gradients(hand, 5)
    for value in hand.value.values():
        value.grad[1] *= 0.01
        value.grad[2] = 0.0
    slope = {name: RATES[name] * value.grad.double() for name, value in hand.value.items()}
    OffsetDescent(hand, RATES, 0.99, by_parameter=False).step(0.5)
    in_steps = {name: value.detach().double() / RATES[name] for name, value in hand.value.items()}
    for frame in (0, 1):
        step = torch.cat([in_steps[name][frame].flatten() for name in RATES])
        along = torch.cat([slope[name][frame].flatten() for name in RATES])
        assert float(step.norm()) == pytest.approx(0.5, rel=1e-4)
        assert float(step @ along / (step.norm() * along.norm())) == pytest.approx(-1.0, abs=1e-5)
    assert all(not value[2].any() for value in in_steps.values())


def test_a_frame_whose_gradient_is_only_rounding_hardly_moves() -> None:
    hand = offsets()
    gradients(hand, 5)
    for value in hand.value.values():
        value.grad[1] *= 1e-7
    OffsetDescent(hand, RATES, 0.99, by_parameter=False).step(1.0)
    in_steps = torch.cat([(v / RATES[name]).flatten(1) for name, v in hand.value.items()], 1)
    size = in_steps.detach().norm(dim=1)
    assert float(size[0]) == pytest.approx(1.0, rel=0.7)
    steepest = float(size.max())
    assert steepest == pytest.approx(1.0, rel=1e-4)
    assert 1e-6 < float(size[1]) < 1e-3


def test_no_gradient_is_no_step() -> None:
    hand = offsets()
    for by_parameter in (True, False):
        OffsetDescent(hand, RATES, 0.99, by_parameter=by_parameter).step(1.0)
    assert all(not value.any() for value in hand.value.values())


def test_control_nodes_are_the_chosen_vertices_of_all_hands() -> None:
    right, left = torch.arange(12.0).reshape(1, 4, 3), torch.arange(20.0, 29).reshape(1, 3, 3)
    assert control_nodes([right, left], None).shape == (1, 7, 3)
    chosen = control_nodes([right, left], np.array([5, 0, 3]))
    assert chosen.tolist() == [[[23.0, 24, 25], [0, 1, 2], [9, 10, 11]]]
