"""Virtual springs that act for some frames only: oracle, closed forms, gradients and bits."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from reference.gradients import directional_difference, gradients, loss_weights
from reference.scenes import as_model, bare_scene, cube_scene, held_in_turns
from reference.spring_mass import simulate

from physhandi.errors import SimulationDivergedError
from physhandi.fitting.rest_state import hold_still
from physhandi.simulation import differentiable
from physhandi.simulation.contact_intervals import NEVER, ContactIntervals
from physhandi.simulation.engines.batch import BatchSimulator
from physhandi.simulation.master_topology import MasterTopology
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.restart import Restart
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.stability import largest_stable_step
from physhandi.simulation.topology import build_model, retopologize

PULL, REST, RATE = 40.0, 0.5, 1000.0
"""Stiffness [N], rest length [m] and substeps a second of the single spring below."""


@pytest.mark.parametrize("distance", [None, 0.002], ids=["engine", "self_collision"])
def test_every_frame_has_the_springs_that_are_attached_then(
    device: str, distance: float | None
) -> None:
    scene = held_in_turns(distance=distance)
    position, velocity = simulate(scene)
    simulator = Simulator(*as_model(scene), device=device)
    found = simulator.rollout(scene.control)
    np.testing.assert_allclose(found.position, position, atol=2e-7)
    np.testing.assert_allclose(found.velocity, velocity, atol=2e-5)
    # Used again, the simulator begins with the springs of the first frame.
    np.testing.assert_array_equal(simulator.rollout(scene.control).position, found.position)
    # One frame earlier or later, and springs that always act, are other motions.
    for wrong in (scene.attached - 1, scene.attached + 1, None):
        other = simulate(replace(scene, attached=wrong))[0]
        assert np.abs(found.position - other).max() > 1e-4
    for spring in (-5, -4, -3, -1):
        for end in (0, 1):
            moved = scene.attached.copy()
            moved[spring, end] += 1 if end == 0 else -1
            other = simulate(replace(scene, attached=moved))[0]
            if moved[spring, end] < 90:
                assert np.abs(found.position - other).max() > 1e-5


def test_springs_that_always_act_are_the_same_bits_as_ever(device: str) -> None:
    scene = cube_scene()
    model, parameters = as_model(scene)
    assert model.is_always_attached
    assert model.attached.tolist() == [[0, NEVER]] * 5
    assert model.held_in(2) is model
    plain = Simulator(model, parameters, device).rollout(scene.control)
    long = replace(model, attached=np.tile(np.int32([[0, 50]]), (5, 1)))
    same = Simulator(long, parameters, device).rollout(scene.control)
    np.testing.assert_array_equal(plain.position, same.position)
    np.testing.assert_array_equal(plain.velocity, same.velocity)


def one_spring(
    attached: list[int], **changes: Any
) -> tuple[SpringMassModel, SimulationParameters, np.ndarray]:
    """1 kg below a control node, one substep a frame, and controls that do not move."""
    scene = bare_scene(
        [[0.0, 0.0, -1.0]],
        springs=[(0, 1)],
        rest=[REST],
        stiffness=[PULL],
        damping=[0.0],
        control=np.zeros((8, 1, 3)),
        frame_rate=RATE,
        substeps=1,
        **changes,
    )
    model, parameters = as_model(scene)
    return replace(model, attached=np.int32([attached])), parameters, scene.control


def test_a_hand_that_comes_late_pulls_from_its_frame_on(device: str) -> None:
    model, parameters, control = one_spring([3, NEVER])
    rollout = Simulator(model, parameters, device).rollout(control)
    assert np.abs(rollout.velocity[:4]).max() == 0.0
    assert np.abs(rollout.position[:4] - model.object_node).max() == 0.0
    # At twice its rest length the spring pulls with its stiffness: 40 N at 1 kg for 1 ms.
    np.testing.assert_allclose(rollout.velocity[4, 0], [0.0, 0.0, PULL / RATE], rtol=1e-6)


def test_what_is_caught_far_from_where_it_was_seen_is_fast_and_stable(device: str) -> None:
    """Springs of 5 mm with 16 kN each catch a node 30 mm away, at 170 m/s."""
    scene = bare_scene(
        [[0.0, 0.0, -0.03]],
        springs=[(0, 1)] * 15,
        rest=[0.005] * 15,
        stiffness=[16000.0] * 15,
        damping=[40.0] * 15,
        control=np.zeros((6, 1, 3)),
        frame_rate=4000.0,
        substeps=5,
    )
    model, parameters = as_model(scene)
    late = replace(model, attached=np.int32([[1, NEVER]] * 15))
    with pytest.raises(SimulationDivergedError, match="not finite or faster than 50 m/s"):
        Simulator(late, parameters, device).rollout(scene.control)
    quick = parameters.replace(speed_limit=1000.0)
    caught = Simulator(late, quick, device).rollout(scene.control)
    position, velocity = simulate(replace(scene, attached=np.array([[1, 99]] * 15)))
    np.testing.assert_allclose(caught.position, position, atol=1e-5)
    np.testing.assert_allclose(caught.velocity, velocity, atol=1e-1)
    assert np.linalg.norm(velocity, axis=-1).max() > 150.0


def test_what_is_let_go_keeps_its_momentum_and_falls(device: str) -> None:
    model, parameters, control = one_spring([0, 3], velocity=[[0.2, 0.0, 0.0]])
    rollout = Simulator(model, parameters, device).rollout(control)
    speed = rollout.velocity[:, 0]
    assert np.all(np.diff(speed[:4, 2]) > 0.03)
    np.testing.assert_array_equal(speed[3:], np.broadcast_to(speed[3], (5, 3)))
    falling = parameters.replace(gravity=10.0)
    speed = Simulator(model, falling, device).rollout(control).velocity[:, 0]
    assert speed[2, 2] > 0.05
    np.testing.assert_allclose(np.diff(speed[3:], axis=0)[:, 2], -10.0 / RATE, rtol=1e-4)
    np.testing.assert_array_equal(speed[3:, :2], np.broadcast_to(speed[3, :2], (5, 2)))


def test_what_nothing_holds_falls_freely(device: str) -> None:
    model, parameters, control = one_spring([20, NEVER])
    rollout = Simulator(model, parameters.replace(gravity=10.0), device).rollout(control)
    step = np.arange(8)
    # Semi-implicit Euler: the velocity of a step moves it.
    fallen = -10.0 / RATE**2 * step * (step + 1) / 2
    np.testing.assert_allclose(rollout.position[:, 0, 2] + 1.0, fallen, atol=2e-7)
    assert fallen[-1] < -2e-4


def test_gradients_reach_across_a_change_of_springs(device: str) -> None:
    scene = held_in_turns()
    weights = loss_weights(scene)
    found = gradients(scene, device, weights)
    rng = np.random.default_rng(2)
    for name in ("control", "log_stiffness", "damping", "initial_position"):
        direction = rng.normal(size=found[name].shape)
        expected = directional_difference(scene, weights, name, direction)
        assert float((found[name] * direction).sum()) == pytest.approx(expected, rel=1e-4), name
    # The last of them acts in the last frame alone, whose state a loss of earlier ones is not of.
    earlier = gradients(scene, device, loss_weights(scene, slice(0, 3)))
    for name in ("log_stiffness", "damping"):
        assert earlier[name][-1] == 0.0
        assert abs(found[name][-1]) > 1e-5
    # Frames whose substeps are not stored are simulated again with their own springs.
    again = gradients(scene, device, weights, memory=1)
    for name, gradient in found.items():
        np.testing.assert_array_equal(again[name], gradient)


def test_a_window_is_told_which_frame_it_begins_with() -> None:
    scene = held_in_turns()
    model, parameters = as_model(scene)
    whole = Simulator(model, parameters).rollout(scene.control)
    control = torch.tensor(scene.control[1:], dtype=torch.float32)
    state = {
        "initial_position": torch.tensor(whole.position[1]),
        "initial_velocity": torch.tensor(whole.velocity[1]),
    }
    part, _ = differentiable.rollout(model, parameters, control, first_frame=1, **state)
    np.testing.assert_allclose(part.numpy(), whole.position[1:], atol=1e-7)
    other, _ = differentiable.rollout(model, parameters, control, **state)
    assert np.abs(other.numpy() - whole.position[1:]).max() > 1e-4


def test_a_model_knows_what_acts_in_a_frame() -> None:
    model, _ = as_model(held_in_turns())
    own = model.object_spring_count
    acting = [model.acts_in(frame)[own:].tolist() for frame in range(4)]
    assert acting[0] == acting[1] == [True, False, False, True, False]
    assert acting[2:] == [[False, True, True, True, False], [False, False, True, True, True]]
    held = model.held_in(2)
    assert held.is_always_attached
    np.testing.assert_array_equal(held.stiffness[:own], model.stiffness[:own])
    np.testing.assert_array_equal(held.stiffness[own:] > 0.0, acting[2])
    np.testing.assert_array_equal(held.damping[own:] > 0.0, acting[2])


def test_attachments_are_stored_and_older_models_have_none() -> None:
    model, _ = as_model(held_in_turns())
    tensors = model.to_tensors()
    np.testing.assert_array_equal(
        SpringMassModel.from_tensors(tensors).attached, [[0, 1], [1, 2], [1, 99], [0, 99], [2, 3]]
    )
    del tensors["attached"]
    assert SpringMassModel.from_tensors(tensors).is_always_attached
    with pytest.raises(ValueError, match=r"attached has shape \(4, 2\); expected \(5, 2\)"):
        replace(model, attached=model.attached[:4])


def contacts_of(scene: object) -> ContactIntervals:
    """Three pairs near each other, one of them twice, and one that is too far."""
    return ContactIntervals(
        node=np.int32([4, 5, 4, 6]),
        control=np.int32([0, 0, 0, 2]),
        distance=np.float32([0.006, 0.008, 0.004, 0.03]),
        rank=np.int32([0, 1, 0, 0]),
        interval=np.int32([[0, 1], [1, 2], [2, NEVER], [0, NEVER]]),
    )


NEAR = SimulationParameters(
    connection_radius=0.05,
    virtual_connection_radius=0.01,
    virtual_max_neighbors=2,
    stiffness=30.0,
    virtual_stiffness=20.0,
    damping=1.0,
    substeps_per_frame=60,
)


def test_springs_are_laid_from_contacts() -> None:
    scene = cube_scene()
    node, control = scene.node.astype(np.float32), scene.control.astype(np.float32)
    model = build_model(node, control[0], NEAR, contacts=contacts_of(scene))
    own = model.object_spring_count
    assert model.spring_nodes[own:].tolist() == [[4, 8], [4, 8], [5, 8]]
    assert model.attached.tolist() == [[0, 1], [2, NEVER], [1, 2]]
    np.testing.assert_allclose(model.rest_length[own:], [0.006, 0.004, 0.008], rtol=1e-6)
    one = NEAR.replace(virtual_max_neighbors=1)
    assert len(build_model(node, control[0], one, contacts=contacts_of(scene)).attached) == 2
    fitted = replace(model, stiffness=model.stiffness * np.float32(1 + np.arange(own + 3)))
    wider = retopologize(
        fitted,
        NEAR.replace(virtual_connection_radius=0.04),
        control[0],
        fitted=NEAR,
        contacts=contacts_of(scene),
    )
    assert wider.attached.tolist() == [[0, 1], [2, NEVER], [1, 2], [0, NEVER]]
    # Both springs of the pair keep their own values, and the new one has that of all.
    expected = 20.0 * np.array([own + 1, own + 2, own + 3, 1])
    np.testing.assert_allclose(wider.stiffness[own:], expected, rtol=1e-6)


def test_candidates_of_a_search_have_the_springs_of_their_contacts(device: str) -> None:
    scene = cube_scene()
    node, control = scene.node.astype(np.float32), scene.control.astype(np.float32)
    drawn = [NEAR, NEAR.replace(virtual_connection_radius=0.007), NEAR.replace(stiffness=25.0)]
    contacts = contacts_of(scene)
    master = MasterTopology.of(node, control[0], drawn, contacts=contacts)
    batch = BatchSimulator(master, drawn, device)
    found = batch.rollout(control).position
    for parameters, position in zip(drawn, found, strict=True):
        model = build_model(node, control[0], parameters, contacts=contacts)
        np.testing.assert_array_equal(master.model(parameters).attached, model.attached)
        alone = Simulator(model, parameters, device).rollout(control)
        np.testing.assert_allclose(position, alone.position, atol=5e-7)
        always = replace(model, attached=np.full_like(model.attached, [0, NEVER]))
        other = Simulator(always, parameters, device).rollout(control)
        assert np.abs(position - other.position).max() > 1e-4
    assert np.abs(found[0] - found[1]).max() > 1e-5
    # Used again, a batch begins with the springs of the first frame.
    np.testing.assert_array_equal(batch.rollout(control).position, found)


def test_contacts_survive_being_stored_and_are_chosen_by_control_node() -> None:
    contacts = contacts_of(cube_scene())
    again = ContactIntervals.from_tensors(contacts.to_tensors())
    np.testing.assert_array_equal(again.interval, contacts.interval)
    with pytest.raises(ValueError, match="Contacts need the arrays"):
        ContactIntervals.from_tensors({"node": contacts.node})
    with pytest.raises(ValueError, match=r"rank has shape \(3,\); expected \(4,\)"):
        replace(contacts, rank=contacts.rank[:3])


def test_springs_that_come_later_do_not_carry_the_object_at_frame_0() -> None:
    scene = cube_scene(ground=None)
    first, second = np.vstack([scene.node, scene.control[0]])[scene.springs].transpose(1, 0, 2)
    length = np.linalg.norm(second - first, axis=1)
    stiff = replace(scene, rest=length, stiffness=np.full(len(length), 3000.0))
    model, parameters = as_model(stiff)
    late = replace(model, attached=np.int32([[0, NEVER]] * 4 + [[1, NEVER]]))
    held = hold_still(late, scene.control[0].astype(np.float32), parameters)
    changed = held.rest_length != late.rest_length
    assert changed[-5:-1].all()
    assert not changed[-1]
    assert (hold_still(model, scene.control[0], parameters).rest_length != model.rest_length)[-1]


def test_late_springs_count_for_stability_in_every_direction() -> None:
    scene = cube_scene()
    model, parameters = as_model(scene)
    late = replace(model, attached=np.int32([[1, NEVER]] * 5))
    stiff = np.where(np.arange(len(model.stiffness)) >= model.object_spring_count, 1e4, 1.0)
    late, model = (replace(m, stiffness=stiff.astype(np.float32)) for m in (late, model))
    control = scene.control[0].astype(np.float32)
    safe = largest_stable_step(model, parameters)
    assert largest_stable_step(late, parameters, control) == pytest.approx(safe, rel=1e-3)
    known = largest_stable_step(model, parameters, control)
    assert known > 1.001 * safe


@pytest.mark.parametrize(
    ("distance", "eases"),
    [(None, False), (0.002, False), (None, True)],
    ids=["engine", "self_collision", "eased"],
)
def test_hands_go_on_beside_themselves_after_a_restart(
    device: str, distance: float | None, eases: bool
) -> None:
    scene, at = held_in_turns(distance=distance), 2
    own = simulate(scene)[0][at]
    rng = np.random.default_rng(5)
    shift = rng.normal(0, 0.003, own.shape) + np.array([0.0, 0.0, 0.006])
    node = np.float32(own + shift)
    velocity = np.float32(rng.normal(0, 0.1, own.shape))
    restart = Restart(
        frame=at, position=node, velocity=velocity, moves_hands=True, eases_grips=eases
    )
    found = Simulator(*as_model(scene), device=device).rollout(scene.control, restart).position
    # Springs (9, 5), (6, 10) and (7, 11) act in frame 2, (5, 8) and (4, 8) do not.
    moved = np.stack([np.zeros(3), *(node - own)[[5, 6, 7]]])
    first, second = scene.springs.T
    length = [
        np.linalg.norm(point[second] - point[first], axis=1)
        for point in (
            np.vstack([own, scene.control[at]]),
            np.vstack([node, scene.control[at] + moved]),
        )
    ]
    rest = scene.rest * length[1] / length[0]
    # Of the held nodes 6 lies on the ground, 5 and 7 hang; (4, 8) holds one on the ground later.
    on_ground = [[4, 8], [6, 10]]
    is_eased = np.array([eases and sorted(pair) in on_ground for pair in scene.springs.tolist()])
    assert is_eased.sum() == 2 * eases
    kept, rest = rest, np.where(is_eased, length[1], rest)
    later = replace(
        scene,
        node=node.astype(float),
        velocity=velocity.astype(float),
        rest=rest,
        control=scene.control[at:] + moved,
        attached=scene.attached - at,
        clearance=np.where(own[:, 2] < 0.003, np.maximum(node[:, 2], 0.0), 0.0),
        rest_shape=scene.node,
    )
    np.testing.assert_allclose(found[at + 1 :], simulate(later)[0][1:], atol=1e-6)
    still = simulate(replace(later, control=scene.control[at:]))[0]
    assert np.abs(found[at + 1 :] - still[1:]).max() > 1e-4
    if eases:
        tense = simulate(replace(later, rest=kept))[0]
        assert np.abs(found[at + 1 :] - tense[1:]).max() > 1e-4
    tensors = restart.to_tensors()
    stored = Restart.from_tensors(tensors)
    assert (stored.moves_hands, stored.eases_grips) == (True, eases)
    # What older runs stored goes on as they did.
    for name in ("eases_grips", "moves_hands"):
        del tensors[name]
        assert not getattr(Restart.from_tensors(tensors), name)


def test_a_node_that_four_springs_hold_moves_no_hand() -> None:
    node = np.float32([[0, 0, 0], [1, 0, 0]])
    model = SpringMassModel(
        object_node=node,
        initial_velocity=np.zeros_like(node),
        spring_nodes=np.int32([[0, 2], [0, 3], [0, 4], [5, 0], [1, 2], [1, 6]]),
        rest_length=np.ones(6, np.float32),
        stiffness=np.ones(6, np.float32),
        damping=np.ones(6, np.float32),
        object_spring_count=0,
        control_count=5,
    )
    state = node + np.float32([[0.0, 0.0, 0.2], [0.0, 0.4, 0.0]])
    restart = Restart(frame=1, position=state, velocity=np.zeros_like(node), moves_hands=True)
    shift = restart.hand_shift(model, node)
    # Control 0 holds node 0, which four hold, and node 1, which two hold; control 4 node 1 alone.
    expected = np.zeros((5, 3))
    expected[[0, 4], 1] = 0.2, 0.4
    np.testing.assert_allclose(shift, expected, atol=1e-6)
    three = replace(model, attached=np.int32([[0, NEVER]] * 3 + [[4, NEVER]] + [[0, NEVER]] * 2))
    expected[0, 2], expected[1, 2], expected[2, 2] = 0.1, 0.2, 0.2
    np.testing.assert_allclose(restart.hand_shift(three, node), expected, atol=1e-6)
    still = replace(restart, moves_hands=False)
    assert still.hand_shift(model, node) is None
