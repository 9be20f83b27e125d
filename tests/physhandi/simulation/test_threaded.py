"""The fast engine of CPUs, against the recorded kernels and the oracle."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from reference.blocks import PARAMETERS, as_scene, block_gradients, recorded, thrown_block
from reference.gradients import directional_difference, gradients, loss_weights
from reference.scenes import as_model, bare_scene, star_scene, tiny_scene
from reference.spring_mass import simulate

from physhandi.errors import SimulationDivergedError
from physhandi.simulation import differentiable
from physhandi.simulation.engines.cpu import CpuAdjoint, CpuEngine
from physhandi.simulation.simulator import Simulator

pytestmark = pytest.mark.skipif(not wp.is_cpu_available(), reason="this Warp has no CPU device")


def simulator_of(model, parameters=PARAMETERS, threads=None):
    simulator = Simulator(model, parameters, device="cpu")
    assert isinstance(simulator.engine, CpuEngine)
    if threads is not None:
        simulator.engine.threads = threads
    return simulator


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("ground", [0.0, None])
@pytest.mark.parametrize("side", [2, 5])
def test_parts_move_as_the_oracle_says(side, ground, threads):
    model, control = thrown_block(side, frames=3)
    parameters = PARAMETERS.replace(ground_height=ground)
    position, velocity = simulate(as_scene(model, control, parameters))
    rollout = simulator_of(model, parameters, threads).rollout(control)
    assert np.abs(position[-1] - position[0]).max() > 0.005
    assert (position[..., 2].min() < 1e-4) if ground == 0.0 else (position[..., 2].min() < -1e-3)
    np.testing.assert_allclose(rollout.position, position, atol=5e-7)
    np.testing.assert_allclose(rollout.velocity, velocity, atol=5e-5)


@pytest.mark.parametrize("side", [2, 5, 10])
def test_parts_move_as_the_recorded_kernels_do(side):
    model, control = thrown_block(side, clearance=8e-4)
    fast = simulator_of(model).rollout(control)
    slow = recorded(model, "cpu").rollout(control)
    assert np.abs(slow.position[-1] - slow.position[0]).max() > 0.005
    assert slow.position[..., 2].min() < 1e-3
    np.testing.assert_allclose(fast.position, slow.position, atol=2e-6)
    np.testing.assert_allclose(fast.velocity, slow.velocity, atol=2e-4)


@pytest.mark.parametrize("side", [2, 5, 10])
def test_gradients_are_those_of_the_recorded_adjoint(side, monkeypatch):
    model, control = thrown_block(side, frames=3, clearance=8e-4)
    fast = block_gradients(model, control, PARAMETERS, "cpu")
    monkeypatch.setattr(CpuAdjoint, "of", lambda *_: None)
    # Other parameters, so that another simulator is made; the difference is far below rounding.
    slow = block_gradients(model, control, PARAMETERS.replace(frame_rate=30.0 + 1e-9), "cpu")
    for name, theirs in slow.items():
        assert np.abs(theirs).max() > 0
        error = np.linalg.norm(fast[name] - theirs) / np.linalg.norm(theirs)
        assert error < 2e-4, name


def test_a_block_s_gradients_agree_with_central_differences_of_the_oracle():
    model, control = thrown_block(3, frames=2)
    scene = as_scene(model, control)
    weights = loss_weights(scene)
    found = gradients(scene, "cpu", weights)
    rng = np.random.default_rng(2)
    for name in ("control", "log_stiffness", "damping", "friction", "initial_velocity"):
        direction = rng.normal(size=found[name].shape)
        expected = directional_difference(scene, weights, name, direction)
        assert abs(expected) > 1e-5
        assert float((found[name] * direction).sum()) == pytest.approx(expected, rel=1e-3), name


def test_the_number_of_threads_changes_no_bit():
    model, control = thrown_block(9, frames=2)
    alone, together = simulator_of(model, threads=1), simulator_of(model, threads=2)
    first = alone.rollout(control)
    assert np.abs(first.position[1] - first.position[0]).max() > 0.001
    for _ in range(50):
        again = together.rollout(control)
        assert np.array_equal(first.position, again.position)
        assert np.array_equal(first.velocity, again.velocity)


def test_gradients_have_the_same_bits_with_one_thread_and_with_two():
    model, control = thrown_block(9, frames=2)
    found = []
    for threads in (1, 2, 2, 2):
        differentiable._bridge(model, PARAMETERS, "cpu").simulator.engine.threads = threads
        found.append(block_gradients(model, control, PARAMETERS, "cpu"))
    for other in found[1:]:
        for name, value in found[0].items():
            assert np.abs(value).max() > 0
            assert np.array_equal(value, other[name]), name


@pytest.mark.parametrize("threads", [1, 2])
def test_a_node_with_five_hundred_springs_agrees_with_the_oracle(threads):
    scene = star_scene()
    position, _ = simulate(scene)
    rollout = simulator_of(*as_model(scene), threads).rollout(scene.control)
    assert np.abs(position[-1, 0] - position[0, 0]).max() > 1e-4
    np.testing.assert_allclose(rollout.position, position, atol=2e-6)


def test_rest_lengths_of_a_tenth_of_a_millimetre_agree_with_the_oracle():
    scene = tiny_scene()
    position, _ = simulate(scene)
    rollout = simulator_of(*as_model(scene)).rollout(scene.control)
    assert np.abs(position[-1] - position[0]).max() > 2e-5
    np.testing.assert_allclose(rollout.position, position, atol=1e-8)


@pytest.mark.parametrize("count", [1, 3])
def test_nodes_without_springs_fall_as_the_oracle_says(count):
    node = [[0.0, 0.0, 1.0 - 0.1 * i] for i in range(count)]
    scene = bare_scene(node, velocity=[[0.3, 0.0, 0.0]] * count, frames=5, gravity=9.81)
    position, _ = simulate(scene)
    rollout = simulator_of(*as_model(scene)).rollout(scene.control)
    assert position[-1, 0, 2] < 0.95
    np.testing.assert_allclose(rollout.position, position, atol=1e-6)


@pytest.mark.parametrize("threads", [1, 2])
def test_divergence_names_the_same_substep_and_node(threads):
    model, control = thrown_block(5)
    stiff = replace(model, stiffness=(model.stiffness * 3e4).astype(np.float32))
    told = []
    for simulator in (simulator_of(stiff, threads=threads), recorded(stiff, "cpu")):
        with pytest.raises(SimulationDivergedError) as caught:
            simulator.rollout(control)
        told.append((caught.value.frame, caught.value.substep, caught.value.node))
    assert told[0] == told[1]


def test_divergence_in_any_part_is_told_and_forgotten():
    model, control = thrown_block(5)
    simulator = simulator_of(model)
    wanted = simulator.rollout(control).position
    for node in (0, 60, 124):
        velocity = model.initial_velocity.copy()
        velocity[node, 0] = 60.0
        simulator.reset(velocity=velocity)
        with pytest.raises(SimulationDivergedError, match=f"substep 0: node {node} "):
            simulator.step_frame(1, control[0], control[1])
    assert np.array_equal(simulator.rollout(control).position, wanted)


def test_what_sliders_move_acts_on_the_next_frame():
    model, control = thrown_block(4)
    changed = PARAMETERS.replace(stiffness_scale=2.0, drag=20.0, ground_height=0.001)
    stiffness, damping = 1.5 * model.stiffness, 0.5 * model.damping
    simulator, slow = simulator_of(model), recorded(model, "cpu")
    before = simulator.rollout(control).position
    for each in (simulator, slow):
        each.set_parameters(changed)
        each.set_material(stiffness=stiffness, damping=damping)
    after, wanted = simulator.rollout(control).position, slow.rollout(control).position
    assert np.abs(wanted - before).max() > 1e-3
    np.testing.assert_allclose(after, wanted, atol=2e-6)


def test_self_collision_goes_the_recorded_way():
    model, control = thrown_block(3, frames=2)
    collides = PARAMETERS.replace(self_collision=True, collision_distance=0.009)
    simulator = simulator_of(model)
    plain = simulator.rollout(control).position
    simulator.set_parameters(collides)
    wanted = recorded(model, "cpu", collides).rollout(control).position
    assert np.array_equal(simulator.rollout(control).position, wanted)
    assert CpuAdjoint.of(simulator, simulator.engine) is None
    simulator.set_parameters(PARAMETERS)
    assert np.array_equal(simulator.rollout(control).position, plain)
