"""What steered hands hold: gripping anew, letting go, and points of the object that are held."""

from dataclasses import replace

import numpy as np
import pytest

from physhandi.simulation.forces import spring_strains
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.steering import POSE, SteeredHand, SteeredMotion, SteeredSimulation
from physhandi.simulation.topology import build_model

SPACING, RATE, GRAVITY = 0.02, 30.0, 9.81
PARAMETERS = SimulationParameters(
    connection_radius=0.03,
    max_neighbors=8,
    virtual_connection_radius=0.025,
    virtual_max_neighbors=4,
    stiffness=400.0,
    virtual_stiffness=600.0,
    damping=3.0,
    drag=0.0,
    ground_height=None,
    gravity=GRAVITY,
    frame_rate=RATE,
    substeps_per_frame=60,
)


def sheet() -> SteeredMotion:
    """A sheet of 5 × 5 nodes, two neighboring corners of which hands hold from above."""
    grid = np.stack(np.meshgrid(*2 * [np.arange(5.0)], indexing="ij"), axis=-1).reshape(-1, 2)
    node = np.concatenate([SPACING * grid, np.zeros((25, 1))], axis=1).astype(np.float32)
    control = node[[0, 1, 20]] + np.float32([0.0, 0.0, 0.005])
    model = build_model(node, control, PARAMETERS)
    hands = tuple(
        SteeredHand(name=name, control=own, wrist=control[own].mean(axis=0).astype(float))
        for name, own in (("right", np.array([0, 1])), ("left", np.array([2])))
    )
    return SteeredMotion(
        model=model,
        start=(node, np.zeros_like(node)),
        parameters=PARAMETERS,
        control=control,
        hands=hands,
        pose=np.zeros((1, 2, POSE)),
    )


def pairs(motion: SteeredMotion) -> set[tuple[int, int]]:
    """Object node and control node of every virtual spring that acts."""
    model = motion.model
    virtual = slice(model.object_spring_count, None)
    acts = model.stiffness[virtual] > 0
    ends = model.spring_nodes[virtual][acts] - [0, model.node_count]
    return {(int(node), int(control)) for node, control in ends}


def moved(motion: SteeredMotion, pose: np.ndarray, frames: int) -> np.ndarray:
    """Nodes after the hands have gone to other poses on a straight way."""
    way = np.linspace(0, 1, frames + 1)[:, None, None]
    states = list(replace(motion, pose=motion.pose[:1] * (1 - way) + pose * way).simulate())
    return states[-1][0]


def test_what_is_let_go_falls_and_the_rest_is_held() -> None:
    motion = sheet()
    free = motion.let_go(0, motion.start, motion.pose[0])
    assert (free.holds(0), free.holds(1), motion.holds(0)) == (False, True, True)
    assert pairs(free) == {pair for pair in pairs(motion) if pair[1] == 2}
    assert free.is_regripped
    assert not motion.is_regripped
    none = free.let_go(1, free.start, free.pose[0])
    node = list(replace(none, pose=np.zeros((7, 2, POSE))).simulate())[-1][0]
    # Semi-implicit Euler falls by g dt² n (n + 1) / 2 in n steps.
    steps = 6 * PARAMETERS.substeps_per_frame
    fallen = GRAVITY * PARAMETERS.dt**2 * steps * (steps + 1) / 2
    np.testing.assert_allclose(node[:, 2], -fallen, rtol=1e-4)
    assert fallen > 0.19


def test_a_hand_grips_what_is_near_it_where_it_is() -> None:
    motion = sheet()
    rng = np.random.default_rng(3)
    state = (
        (motion.start[0] + rng.normal(scale=0.002, size=(25, 3))).astype(np.float32),
        np.zeros((25, 3), np.float32),
    )
    pose = np.zeros((2, POSE))
    pose[0, :3] = [0.05, 0.045, 0.001]
    grip = motion.let_go(0, state, pose).grip(0, state, pose)
    control = grip.control_at(pose)
    distance = np.linalg.norm(state[0][:, None].astype(float) - control[None], axis=2)
    expected = {pair for pair in pairs(motion) if pair[1] == 2}
    for own in (0, 1):
        nearest = np.argsort(distance[:, own])[: PARAMETERS.virtual_max_neighbors]
        near = nearest[distance[nearest, own] < PARAMETERS.virtual_connection_radius]
        expected |= {(int(node), own) for node in near}
    assert pairs(grip) == expected
    assert len([pair for pair in expected if pair[1] < 2]) == 8
    # It grips without pulling.
    strain = spring_strains(grip.model, state[0], control)
    virtual = slice(grip.model.object_spring_count, None)
    new = grip.model.spring_nodes[virtual].max(axis=1) < 25 + 2
    np.testing.assert_allclose(strain[virtual][new], 0.0, atol=1e-6)
    np.testing.assert_array_equal(grip.model.stiffness[virtual][new], 600.0)
    # Farther away, it grips nothing.
    pose[0, 2] = 0.03
    assert not motion.grip(0, state, pose).holds(0)


def test_a_point_that_is_held_takes_its_node_along() -> None:
    motion = sheet()
    held = motion.hold_point(24, motion.start, motion.pose[0], "point 1")
    assert [hand.name for hand in held.hands] == ["right", "left", "point 1"]
    np.testing.assert_allclose(
        held.control[-1], motion.start[0][24] + [0, 0, 0.5 * PARAMETERS.virtual_connection_radius]
    )
    own = {pair for pair in pairs(held) if pair[1] == 3}
    # Its neighbors along the grid are 2 cm away, those across it 2.8.
    assert own == {(24, 3), (19, 3), (23, 3)}
    assert pairs(held) - own == pairs(motion)
    resting = moved(held, held.pose[0], 30)
    pose = held.pose[0].copy()
    pose[2, 2] = 0.05
    pulled = moved(held, pose, 30) - resting
    # It hangs below the point, about which it turns.
    np.testing.assert_allclose(pulled[24], pose[2, :3], atol=0.008)
    assert np.linalg.norm(pulled[0]) < 0.003


def test_pins_stay_where_they_are_beside_points_and_hands() -> None:
    motion = sheet()
    pinned = replace(motion.model, control_count=4, pin_place=motion.start[0][[4]])
    ends = np.int32([[4, 28]])
    pinned = replace(
        pinned,
        spring_nodes=np.concatenate([pinned.spring_nodes, ends]),
        rest_length=np.append(pinned.rest_length, np.float32(1e-3)),
        stiffness=np.append(pinned.stiffness, np.float32(600.0)),
        damping=np.append(pinned.damping, np.float32(3.0)),
        attached=np.concatenate([pinned.attached, pinned.attached[:1]]),
    )
    control = np.concatenate([motion.control, motion.start[0][[4]]])
    pinned = replace(pinned, hand_face=np.int32([[0, 1, 2], [2, 1, 3]]))
    with_pin = replace(motion, model=pinned, control=control)
    held = with_pin.hold_point(24, motion.start, motion.pose[0], "point 1")
    # The new point has the number of the pin, which has one more; it is no part of a hand.
    np.testing.assert_array_equal(held.model.hand_face, [[0, 1, 2], [2, 1, 4]])
    assert pairs(held) - {(24, 3), (19, 3), (23, 3)} == pairs(motion) | {(4, 4)}
    pose = np.full((3, POSE), 0.01)
    np.testing.assert_array_equal(held.control_at(pose)[4], motion.start[0][4])
    free = held.let_go(0, held.start, pose).let_go(1, held.start, pose)
    assert {control for _, control in pairs(free)} == {3, 4}
    back = held.without_point(2, held.start, held.pose[0])
    assert pairs(back) == pairs(with_pin)
    np.testing.assert_array_equal(back.control, control)
    np.testing.assert_array_equal(back.model.hand_face, pinned.hand_face)
    with pytest.raises(ValueError, match="can move"):
        replace(with_pin, hands=(replace(motion.hands[0], control=np.array([3])), motion.hands[1]))


def test_a_point_that_is_held_no_more_leaves_all_as_it_was() -> None:
    motion = sheet()
    pose = motion.pose[0] + 0.001
    one = motion.hold_point(24, motion.start, pose, "point 1")
    two = one.hold_point(12, motion.start, np.vstack([pose, np.zeros(POSE)]), "point 2")
    last = np.zeros((4, POSE))
    last[:2], last[3] = pose, 0.002
    left = two.without_point(2, motion.start, last)
    assert [hand.name for hand in left.hands] == ["right", "left", "point 2"]
    np.testing.assert_array_equal(left.pose[0], last[[0, 1, 3]])
    assert {pair for pair in pairs(left) if pair[1] == 3} == {
        (node, 3) for node, control in pairs(two) if control == 4
    }
    np.testing.assert_array_equal(left.control_at(left.pose[0])[3], two.control_at(last)[4])
    back = left.without_point(2, motion.start, left.pose[0])
    for name, value in motion.model.to_tensors().items():
        np.testing.assert_array_equal(back.model.to_tensors()[name], value, err_msg=name)
    np.testing.assert_array_equal(back.control, motion.control)


def test_the_object_pulls_at_its_hands_with_its_weight() -> None:
    motion = replace(sheet(), parameters=PARAMETERS.replace(drag=5.0))
    held = motion.hold_point(24, motion.start, motion.pose[0], "point 1")
    steered = SteeredSimulation(replace(held, pose=np.zeros((1, 3, POSE))))
    for _ in range(150):
        state = steered.step(np.zeros((3, POSE)))
    pull = steered.pulls(state)
    # 25 nodes of 1 kg; what stretches it between the corners adds up to nothing.
    np.testing.assert_allclose(pull.sum(axis=0), [0, 0, -25 * GRAVITY], atol=0.5)
    assert (pull[:, 2] < -20).all()
    # A hand that is moving is pulled back by the dashpots, too: where it goes up, harder.
    up = np.zeros((3, POSE))
    up[2, 2] = 0.002
    assert steered.pulls(steered.step(up))[2, 2] < pull[2, 2] - 5


@pytest.mark.parametrize("stiffness", [600.0, 2e5])
def test_more_springs_get_as_many_substeps_as_they_need(stiffness: float) -> None:
    motion = sheet()
    stiff = replace(motion, parameters=PARAMETERS.replace(virtual_stiffness=stiffness))
    held = stiff.hold_point(12, motion.start, motion.pose[0], "point 1")
    count = held.parameters.substeps_per_frame
    # A spring of this stiffness and 12.5 mm has 4 / ω² = 4 L / Y as the square of its longest step.
    needed = 1.0 / (RATE * np.sqrt(4 * 0.0125 / stiffness))
    assert count > needed
    assert (count > 60) == (needed > 60)
    assert np.isfinite(moved(held, held.pose[0], 10)).all()


def test_grips_are_stored_with_every_bit() -> None:
    motion = sheet()
    for changed in (motion, motion.hold_point(7, motion.start, motion.pose[0], "point 1")):
        again = SteeredMotion.from_tensors(changed.to_tensors(), changed.parameters)
        assert again.is_regripped == changed.is_regripped
        for name, value in changed.to_tensors().items():
            np.testing.assert_array_equal(again.to_tensors()[name], value, err_msg=name)
