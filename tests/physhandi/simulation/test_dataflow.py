"""The fast engine of CUDA devices, against the recorded kernels and the oracle."""

from dataclasses import replace

import numpy as np
import pytest
from reference.blocks import PARAMETERS, block_gradients, recorded, thrown_block
from reference.scenes import as_model, bare_scene, star_scene
from reference.spring_mass import simulate

from physhandi.errors import SimulationDivergedError
from physhandi.simulation.engines.cuda import CudaAdjoint, CudaEngine
from physhandi.simulation.engines.graph_adjoint import GraphAdjoint
from physhandi.simulation.simulator import Simulator


def needs_cuda():
    import warp as wp

    if not wp.is_cuda_available():
        pytest.skip("needs a CUDA device")


@pytest.mark.gpu
@pytest.mark.parametrize("side", [2, 5, 10, 15])
def test_blocks_move_as_the_recorded_kernels_do(side):
    needs_cuda()
    model, control = thrown_block(side, clearance=8e-4)
    simulator = Simulator(model, PARAMETERS, device="cuda:0")
    assert simulator.engine is not None
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
    model, control = thrown_block(side, frames=3, clearance=8e-4)
    fast = block_gradients(model, control, PARAMETERS, "cuda:0")
    monkeypatch.setattr(CudaAdjoint, "of", lambda *_: None)
    # Other parameters, so that another simulator is made; the difference is far below rounding.
    slow = block_gradients(model, control, PARAMETERS.replace(frame_rate=30.0 + 1e-9), "cuda:0")
    for name, theirs in slow.items():
        assert np.abs(theirs).max() > 0
        error = np.linalg.norm(fast[name] - theirs) / np.linalg.norm(theirs)
        assert error < 2e-4, name


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
    scene = star_scene()
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
    simulator.engine._relay._tag = 2**31 - 2**20 - 100
    assert np.array_equal(simulator.rollout(control).position, wanted)
    assert simulator.engine._relay._tag < 10_000


def test_a_processor_has_another_engine():
    model, _ = thrown_block(3)
    assert not isinstance(Simulator(model, PARAMETERS, device="cpu").engine, CudaEngine)
    assert CudaAdjoint.of(Simulator(model, PARAMETERS), None) is None
    assert GraphAdjoint(Simulator(model, PARAMETERS)).position_bar.shape == (27,)
