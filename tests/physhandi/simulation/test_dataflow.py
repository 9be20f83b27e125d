"""The fast engine of CUDA devices, against the recorded kernels and the oracle."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from reference.scenes import as_model, bare_scene
from reference.spring_mass import simulate

from physhandi.errors import SimulationDivergedError
from physhandi.simulation import differentiable
from physhandi.simulation.dataflow import DataflowAdjoint
from physhandi.simulation.frame_adjoint import FrameAdjoint
from physhandi.simulation.model import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.topology import build_model

PARAMETERS = SimulationParameters(
    connection_radius=0.018,
    max_neighbors=18,
    stiffness=300.0,
    virtual_stiffness=200.0,
    virtual_connection_radius=0.015,
    damping=3.0,
    substeps_per_frame=150,
)


def needs_cuda():
    import warp as wp

    if not wp.is_cuda_available():
        pytest.skip("needs a CUDA device")


def thrown_block(side, frames=4):
    """Throw a block of jittered nodes at the ground while its top is held."""
    rng = np.random.default_rng(side)
    axis = 0.01 * np.arange(side)
    node = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    node = node + rng.normal(0, 5e-4, node.shape) + np.array([0, 0, 0.002])
    control = node[node[:, 2] > axis[-1]][::7] + np.array([0, 0, 0.004])
    model = build_model(node.astype(np.float32), control.astype(np.float32), PARAMETERS)
    velocity = rng.normal(0, 0.05, node.shape) + np.array([0.1, 0, -0.3])
    path = control + np.linspace(0, 1, frames)[:, None, None] * np.array([0.01, -0.004, 0.003])
    return replace(model, initial_velocity=velocity.astype(np.float32)), path.astype(np.float32)


def recorded(model, device):
    """Make a simulator that does without the fast engine."""
    simulator = Simulator(model, PARAMETERS, device=device)
    simulator.dataflow = None
    return simulator


@pytest.mark.gpu
@pytest.mark.parametrize("side", [2, 5, 10, 15])
def test_blocks_move_as_the_recorded_kernels_do(side):
    needs_cuda()
    model, control = thrown_block(side)
    simulator = Simulator(model, PARAMETERS, device="cuda:0")
    assert simulator.dataflow is not None
    fast = simulator.rollout(control)
    slow = recorded(model, "cuda:0").rollout(control)
    assert np.abs(slow.position[-1] - slow.position[0]).max() > 0.005
    assert slow.position[..., 2].min() < 1e-3
    np.testing.assert_allclose(fast.position, slow.position, atol=2e-6)
    np.testing.assert_allclose(fast.velocity, slow.velocity, atol=2e-4)


@pytest.mark.gpu
@pytest.mark.parametrize("side", [2, 5, 10])
def test_gradients_are_those_of_the_recorded_adjoint(side, monkeypatch):
    needs_cuda()
    model, control = thrown_block(side, frames=3)
    aim = torch.from_numpy(np.random.default_rng(5).normal(0, 1, model.object_node.shape)).float()

    def gradients(parameters):
        inputs = {
            "control": torch.from_numpy(control),
            "log_stiffness": torch.log(torch.from_numpy(model.stiffness)),
            "damping": torch.from_numpy(model.damping),
            "drag": torch.tensor(3.0),
            "restitution": torch.tensor(0.5),
            "friction": torch.tensor(0.3),
            "initial_position": torch.from_numpy(model.object_node),
            "initial_velocity": torch.from_numpy(model.initial_velocity),
        }
        inputs = {name: value.requires_grad_() for name, value in inputs.items()}
        path = inputs.pop("control")
        position, velocity = differentiable.rollout(
            model, parameters, path, device="cuda:0", **inputs
        )
        ((position[-1] * aim).sum() + 0.01 * (velocity[-1] * aim).sum()).backward()
        return [path.grad, *(value.grad for value in inputs.values())]

    fast = gradients(PARAMETERS)
    monkeypatch.setattr(DataflowAdjoint, "of", lambda *_: None)
    # Other parameters, so that another simulator is made; the difference is far below rounding.
    slow = gradients(replace(PARAMETERS, frame_rate=30.0 + 1e-9))
    for ours, theirs in zip(fast, slow, strict=True):
        assert float(theirs.abs().max()) > 0
        error = float((ours - theirs).norm() / theirs.norm())
        assert error < 2e-4, error


@pytest.mark.gpu
def test_a_hundred_runs_give_the_same_bits():
    needs_cuda()
    model, control = thrown_block(9, frames=2)
    simulator = Simulator(model, PARAMETERS, device="cuda:0")
    first = simulator.rollout(control)
    for _ in range(99):
        again = simulator.rollout(control)
        assert np.array_equal(first.position, again.position)
        assert np.array_equal(first.velocity, again.velocity)


@pytest.mark.gpu
def test_a_node_with_five_hundred_springs_agrees_with_the_oracle():
    needs_cuda()
    rng = np.random.default_rng(2)
    direction = rng.normal(size=(500, 3))
    node = np.vstack([np.zeros(3), 0.1 * direction / np.linalg.norm(direction, axis=1)[:, None]])
    scene = bare_scene(
        node,
        velocity=rng.normal(0, 0.2, node.shape),
        springs=[(0, i) for i in range(1, 501)],
        rest=np.full(500, 0.09),
        stiffness=np.full(500, 2.0),
        damping=np.full(500, 0.05),
        frames=3,
        substeps=60,
    )
    position, _ = simulate(scene)
    rollout = Simulator(*as_model(scene), device="cuda:0").rollout(scene.control)
    assert np.abs(position[-1, 0] - position[0, 0]).max() > 1e-4
    np.testing.assert_allclose(rollout.position, position, atol=2e-6)


@pytest.mark.gpu
def test_one_node_and_no_spring_fall_as_the_oracle_says():
    needs_cuda()
    scene = bare_scene([[0.0, 0.0, 1.0]], velocity=[[0.3, 0.0, 0.0]], frames=5, gravity=9.81)
    position, _ = simulate(scene)
    rollout = Simulator(*as_model(scene), device="cuda:0").rollout(scene.control)
    assert position[-1, 0, 2] < 0.95
    np.testing.assert_allclose(rollout.position, position, atol=1e-6)


@pytest.mark.gpu
def test_divergence_names_the_same_substep_and_node():
    needs_cuda()
    model, control = thrown_block(5)
    stiff = replace(model, stiffness=(model.stiffness * 3e4).astype(np.float32))
    told = []
    for simulator in (Simulator(stiff, PARAMETERS, device="cuda:0"), recorded(stiff, "cuda:0")):
        with pytest.raises(SimulationDivergedError) as caught:
            simulator.rollout(control)
        told.append((caught.value.frame, caught.value.substep))
    assert told[0] == told[1]


@pytest.mark.gpu
def test_tags_begin_again_before_they_run_out(monkeypatch):
    needs_cuda()
    model, control = thrown_block(4)
    simulator = Simulator(model, PARAMETERS, device="cuda:0")
    wanted = simulator.rollout(control).position
    simulator.dataflow._tag = 2**31 - 2**20 - 100
    assert np.array_equal(simulator.rollout(control).position, wanted)
    assert simulator.dataflow._tag < 10_000


def test_a_processor_has_no_fast_engine():
    model, _ = thrown_block(3)
    assert Simulator(model, PARAMETERS, device="cpu").dataflow is None
    assert DataflowAdjoint.of(Simulator(model, PARAMETERS), None) is None
    assert FrameAdjoint(Simulator(model, PARAMETERS)).position_bar.shape == (27,)
