"""A rope that bends: forces against differences of an energy, motion against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from reference.elastic_rod import ElasticRod

from physhandi.errors import SimulationError
from physhandi.fitted_object import FittedObject
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.engines.rod_force import RodForce
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.rod import Rod
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.stability import largest_stable_step
from physhandi.simulation.topology import build_model

STEP = 0.1
"""Distance of nodes along the straight ropes here [m]."""


def rod_of(node: np.ndarray, **values) -> Rod:
    edge = np.linalg.norm(np.diff(node, axis=0), axis=1)
    length = 0.5 * (np.append(edge, edge[-1]) + np.append(edge[0], edge))
    rod = Rod(
        node=np.arange(len(node), dtype=np.int32),
        held_by=0,
        length=length.astype(np.float32),
        natural_curvature=np.zeros((len(node), 2), np.float32),
        stiffness=0.3,
        damping=0.0,
        twist_stiffness=0.2,
    )
    return replace(rod, **values)


def crooked_rope() -> tuple[SpringMassModel, Rod, np.ndarray]:
    """Nine nodes in space without springs, their rod, the way to the point that holds its axes."""
    random = np.random.default_rng(3)
    node = np.cumsum(random.normal(size=(9, 3)) * 0.05 + [0.1, 0, 0], axis=0)
    tangent = (node[1] - node[0]) / np.linalg.norm(node[1] - node[0])
    arm = np.cross(tangent, [0.0, 0.0, 1.0])
    arm *= 0.05 / np.linalg.norm(arm)
    natural = 3.0 * random.normal(size=(9, 2))
    rod = rod_of(node, natural_curvature=natural.astype(np.float32))
    none = np.zeros(0, np.float32)
    model = SpringMassModel(
        object_node=node.astype(np.float32),
        initial_velocity=np.zeros((9, 3), np.float32),
        spring_nodes=np.zeros((0, 2), np.int32),
        rest_length=none,
        stiffness=none,
        damping=none,
        object_spring_count=0,
        control_count=1,
        rod=rod,
    )
    return model, rod, arm


def bending_forces(
    model: SpringMassModel, control: np.ndarray, rounds: int, device: str = "cpu"
) -> np.ndarray:
    """Force on each vertex after so many substeps in which no node moves [N]."""
    parameters = SimulationParameters(gravity=0.0, ground_height=None, substeps_per_frame=100)
    simulator = Simulator(model, parameters, device=device)
    simulator.control_start.assign(control.astype(np.float32))
    simulator.control_end.assign(control.astype(np.float32))
    state = [simulator.position, simulator.velocity, *simulator.controls]
    force = simulator.rod
    assert isinstance(force, RodForce)
    for _ in range(rounds):
        force.launch(1.0, simulator.world, state, simulator.sums.pull)
    return simulator.sums.pull.numpy()[len(model.spring_nodes) :]


def test_forces_are_differences_of_the_energy_when_the_twist_has_settled(device):
    model, rod, arm = crooked_rope()
    node = model.object_node.astype(np.float64)
    natural = rod.natural_curvature[1:-1].astype(np.float64)
    reference = ElasticRod(rod.length[1:-1].astype(np.float64), natural, 0.3, 0.2)
    expected = reference.force(node, arm)
    assert np.abs(reference.balanced(node, arm)).max() > 0.3
    force = bending_forces(model, (node[0] + arm)[None], rounds=60, device=device)
    assert np.abs(expected).max() > 50.0
    np.testing.assert_allclose(force, expected, atol=2e-3)
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-4)


def test_damping_is_the_rate_at_which_curvature_changes(device):
    """A straight rope of which one node moves across: κ grows by 2v/h there, -v/h beside it."""
    node = np.zeros((7, 3), np.float32)
    node[:, 0] = STEP * np.arange(7)
    model, rod, _ = crooked_rope()
    velocity = np.zeros((7, 3), np.float32)
    velocity[3, 1] = 0.4
    rod = rod_of(node, damping=0.02)
    model = replace(
        model, object_node=node, initial_velocity=velocity, rod=rod, clearance=node[:, 0]
    )
    force = bending_forces(model, np.array([[0.0, 0.0, 0.05]]), rounds=1, device=device)
    share = 0.3 * 0.02 / STEP * (0.4 / STEP) / STEP
    expected = np.zeros((7, 3))
    expected[1:6, 1] = share * np.array([-1.0, 4.0, -6.0, 4.0, -1.0])
    np.testing.assert_allclose(force, expected, atol=1e-5 * share)


def clamped_rope(count: int = 11, **values) -> tuple[SpringMassModel, np.ndarray]:
    """A straight rope along x whose first two nodes two controls hold; a third holds the axes."""
    node = np.zeros((count, 3))
    node[:, 0] = STEP * np.arange(count)
    control = np.array([node[0], node[1], [0.0, 0.0, 0.5 * STEP]])
    parameters = SimulationParameters(
        stiffness=1e5,
        virtual_stiffness=40.0,
        virtual_rest_length_floor=1e-5,
        virtual_connection_radius=0.01,
        virtual_max_neighbors=1,
        damping=100.0,
    )
    rod = rod_of(node, held_by=2, twist_stiffness=50.0, **values)
    return build_model(node.astype(np.float32), control, parameters, rod=rod), control


def settled(
    model: SpringMassModel, control: np.ndarray, device: str = "cpu", **values
) -> np.ndarray:
    """Where the nodes are after two seconds, with much drag."""
    parameters = SimulationParameters(ground_height=None, drag=8.0, substeps_per_frame=80, **values)
    still = np.repeat(control[None].astype(np.float32), 61, axis=0)
    return Simulator(model, parameters, device=device).rollout(still).position[-1]


def test_a_cantilever_hangs_down_as_beams_do(device):
    """Each vertex turns by what hangs beyond it, M h / B; of a stiff rope the angles add up."""
    model, control = clamped_rope(stiffness=100.0, damping=0.001)
    node = settled(model, control, device, gravity=5.0)
    moment = 5.0 * STEP * np.array([sum(range(1, 11 - vertex)) for vertex in range(1, 10)])
    tip = STEP * np.cumsum(moment * STEP / 100.0).sum()
    assert tip > 0.03
    # The grip gives way a little, and the rope with it.
    tilt = (node[1, 2] - node[0, 2]) / STEP
    assert abs(tilt) < 5e-3
    assert node[-1, 2] - node[1, 2] - 9 * STEP * tilt == pytest.approx(-tip, rel=0.01)
    assert abs(node[-1, 1]) < 1e-4


def test_a_rope_takes_the_curvature_that_it_has_at_rest_and_keeps_it():
    natural = np.zeros((11, 2), np.float32)
    natural[:, 1] = 2.0
    model, control = clamped_rope(natural_curvature=natural, stiffness=50.0, damping=0.001)
    node = settled(model, control, gravity=0.0)
    edge = np.diff(node, axis=0)
    tangent = edge / np.linalg.norm(edge, axis=1, keepdims=True)
    # κ = 2 tan(φ/2) = 2/m x 0.1 m at each vertex, about minus the first axis, which points up.
    turned = np.arctan2(tangent[:, 1], tangent[:, 0])
    expected = -2.0 * np.arctan(0.1) * np.arange(10)
    np.testing.assert_allclose(turned, expected, atol=2e-3)
    assert np.abs(node[:, 2]).max() < 1e-3
    bent = replace(model, object_node=node.astype(np.float32))
    assert np.abs(bending_forces(model, control, 1)).max() > 900.0
    np.testing.assert_allclose(bending_forces(bent, control, 1), 0.0, atol=0.3)


def test_the_axes_turn_with_the_gripper():
    natural = np.zeros((11, 2), np.float32)
    natural[:, 1] = 2.0
    model, control = clamped_rope(natural_curvature=natural, stiffness=50.0, damping=0.001)
    control[2] = [0.0, 0.5 * STEP, 0.0]
    node = settled(model, control, gravity=0.0)
    # Turned by a quarter about x, up becomes y: what bent towards -y bends up.
    assert node[-1, 2] > 0.4
    assert np.abs(node[:, 1]).max() < 1e-3


def test_a_bending_mode_dies_out_as_its_damping_says(device):
    """A free rope bent in its first mode: with ω² = λ B and damping ω² τ, ζ = ω τ / 2."""
    count, stiffness, tau = 9, 4.0, 0.01
    node = np.zeros((count, 3), np.float32)
    node[:, 0] = STEP * np.arange(count)
    second = np.diff(np.eye(count), n=2, axis=0) / STEP
    value, mode = np.linalg.eigh(second.T @ second * stiffness / STEP)
    omega = np.sqrt(value[2])
    velocity = np.zeros((count, 3), np.float32)
    velocity[:, 1] = 0.05 * mode[:, 2]
    model, rod, _ = crooked_rope()
    rod = rod_of(node, stiffness=stiffness, damping=tau)
    model = replace(
        model, object_node=node, initial_velocity=velocity, rod=rod, clearance=node[:, 0]
    )
    parameters = SimulationParameters(
        gravity=0.0, ground_height=None, drag=0.0, frame_rate=100.0, substeps_per_frame=40
    )
    far = np.repeat(np.array([[[0.0, 0.0, 0.05]]], np.float32), 41, axis=0)
    rollout = (
        Simulator(model, parameters, device=device).rollout(far).position[:, :, 1] @ mode[:, 2]
    )
    time, ratio = 0.01 * np.arange(41), 0.5 * omega * tau
    slowed = omega * np.sqrt(1.0 - ratio**2)
    expected = 0.05 / slowed * np.exp(-ratio * omega * time) * np.sin(slowed * time)
    assert 0.02 < ratio < 0.3
    np.testing.assert_allclose(rollout, expected, atol=0.02 * np.abs(expected).max())


def test_a_rope_is_simulated_the_same_way_twice_and_twist_does_not_stay(device):
    model, rod, arm = crooked_rope()
    parameters = SimulationParameters(ground_height=None, substeps_per_frame=200)
    control = np.repeat((model.object_node[0] + arm)[None, None].astype(np.float32), 6, axis=0)
    simulator = Simulator(model, parameters, device=device)
    first = simulator.rollout(control).position
    assert np.abs(first[5] - first[0]).max() > 0.01
    np.testing.assert_array_equal(simulator.rollout(control).position, first)
    stiffer = replace(rod, stiffness=0.6)
    simulator.set_rod(stiffer)
    changed = simulator.rollout(control).position
    np.testing.assert_array_equal(
        changed,
        Simulator(replace(model, rod=stiffer), parameters, device=device).rollout(control).position,
    )
    assert np.abs(changed - first).max() > 1e-3


def test_other_springs_and_other_grips_keep_the_rod():
    model, control = clamped_rope()
    parameters = SimulationParameters(virtual_stiffness=40.0, virtual_connection_radius=0.01)
    still = np.repeat(control[None].astype(np.float32), 3, axis=0)
    fitted = FittedObject(ObjectRollout.empty(model, parameters, still))
    wider = fitted.begin(parameters.replace(connection_radius=0.25)).model
    assert wider.rod is model.rod
    np.testing.assert_array_equal(wider.spring_nodes, model.spring_nodes)
    some = fitted.begin(parameters, controls=[0, 2]).model
    assert some.rod is not None
    assert (some.control_count, some.rod.held_by) == (2, 1)
    # Who does not hold the axes lets the rope hang by its springs.
    assert fitted.begin(parameters, controls=[0, 1]).model.rod is None


def test_bending_shortens_the_longest_stable_substep():
    """A free chain's highest bending mode has κ = 4v/h: dt² 16 B/h³ + 2 dt 16 B τ/h³ = 4."""
    node = np.zeros((60, 3), np.float32)
    node[:, 0] = STEP * np.arange(60)
    model, rod, _ = crooked_rope()
    rod = rod_of(node, stiffness=4.0, damping=0.01)
    model = replace(
        model, object_node=node, initial_velocity=0 * node, rod=rod, clearance=node[:, 0]
    )
    load = 16.0 * 4.0 / STEP**3
    expected = (-load * 0.01 + np.sqrt((load * 0.01) ** 2 + 4.0 * load)) / load
    step = largest_stable_step(model, SimulationParameters())
    assert step == pytest.approx(expected, rel=0.02)


def test_a_gradient_through_a_rope_is_refused():
    import torch

    from physhandi.simulation.differentiable import rollout

    model, _, arm = crooked_rope()
    control = torch.tensor((model.object_node[0] + arm)[None, None].repeat(2, axis=0))
    parameters = SimulationParameters(substeps_per_frame=200)
    with pytest.raises(SimulationError, match="rope that bends has no gradient"):
        rollout(model, parameters, control.float().requires_grad_())


def test_a_rod_survives_being_stored_and_refuses_nonsense():
    model, rod, _ = crooked_rope()
    tensors = model.to_tensors()
    again = SpringMassModel.from_tensors(tensors)
    assert again.rod is not None
    assert again.rod.to_tensors().keys() <= tensors.keys()
    for name, value in again.to_tensors().items():
        np.testing.assert_array_equal(value, tensors[name])
    without = {name: value for name, value in tensors.items() if not name.startswith("rod_")}
    assert SpringMassModel.from_tensors(without).rod is None
    del tensors["rod_length"]
    with pytest.raises(ValueError, match="rod_length"):
        SpringMassModel.from_tensors(tensors)
    for field, value in {
        "node": np.zeros(9, np.int32),
        "held_by": 1,
        "length": rod.length[:3],
        "stiffness": -1.0,
    }.items():
        with pytest.raises(ValueError, match=f"rod_{field}"):
            replace(model, rod=replace(rod, **{field: value}))
