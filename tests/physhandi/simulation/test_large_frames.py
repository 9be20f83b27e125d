"""The frame kernel with dynamic shared memory, against the recorded kernels and the oracle."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from reference.blocks import PARAMETERS, as_scene, block_gradients, recorded, thrown_block
from reference.spring_mass import simulate

from physhandi.errors import SimulationDivergedError
from physhandi.simulation.engines import cuda
from physhandi.simulation.engines.cuda import LargeLayout, most_large_locals
from physhandi.simulation.engines.partition import Partition
from physhandi.simulation.kernels.cuda_frame import FORWARD_LOCALS
from physhandi.simulation.simulator import Simulator

H200_BYTES = 232448


def blocks_of(own, locals_, springs):
    """Describe one block whose nodes have as many springs each."""
    return Partition(
        own_start=np.array([0, own], dtype=np.int32),
        model_node=np.arange(own, dtype=np.int32),
        local_start=np.array([0, locals_], dtype=np.int32),
        local_node=np.arange(locals_, dtype=np.int32),
        entry_start=springs * np.arange(own + 1, dtype=np.int32),
        entry=np.zeros((own * springs, 2), dtype=np.int32),
        is_first=np.ones(own * springs, dtype=np.int32),
    )


@pytest.fixture
def large(monkeypatch):
    """Make simulators on CUDA use the large kernel, however small the object is."""
    import warp as wp

    if not wp.is_cuda_available():
        pytest.skip("needs a CUDA device")
    monkeypatch.setattr(cuda, "FORWARD_LOCALS", 0)

    def make(model, parameters=PARAMETERS, layout=None):
        if layout is not None:
            monkeypatch.setattr(cuda.LargeLayout, "of", lambda *_: layout)
        simulator = Simulator(model, parameters, device="cuda:0")
        assert simulator.engine.large is not None
        return simulator

    return make


def test_a_block_has_the_room_that_its_device_leaves():
    assert most_large_locals(SimpleNamespace(max_shared_memory_per_block=H200_BYTES)) == 3584
    assert most_large_locals(SimpleNamespace(max_shared_memory_per_block=101376)) == 1536
    assert most_large_locals(SimpleNamespace(max_shared_memory_per_block=0)) == 0


@pytest.mark.parametrize(
    ("own", "locals_", "springs", "expected"),
    [
        (379, 963, 23, (2, 6, 768, 1024)),
        (152, 1025, 57, (4, 6, 768, 1536)),
        (60, 800, 9, (8, 2, 512, 1024)),
        (450, 900, 23, (1, 14, 512, 1024)),
        (1515, 3100, 23, (1, 6, 768, 3584)),
        (1600, 3584, 0, (1, 1, 768, 3584)),
    ],
)
def test_threads_suit_the_blocks(own, locals_, springs, expected):
    layout = LargeLayout.of(blocks_of(own, locals_, springs), 3584)
    assert (layout.lanes, layout.in_registers, layout.threads, layout.locals) == expected


def test_room_is_not_rounded_up_beyond_the_device():
    assert LargeLayout.of(blocks_of(200, 1500, 18), 1530).locals == 1530


@pytest.mark.gpu
@pytest.mark.parametrize("side", [2, 5])
def test_blocks_move_as_the_oracle_says(side, large):
    model, control = thrown_block(side, frames=3)
    position, velocity = simulate(as_scene(model, control))
    rollout = large(model).rollout(control)
    assert np.abs(position[-1] - position[0]).max() > 0.005
    assert position[..., 2].min() < 1e-4
    np.testing.assert_allclose(rollout.position, position, atol=2e-6)
    np.testing.assert_allclose(rollout.velocity, velocity, atol=2e-4)


@pytest.mark.gpu
@pytest.mark.parametrize(
    "layout",
    [
        None,
        LargeLayout(lanes=1, in_registers=16, threads=512, locals=1024),
        LargeLayout(lanes=2, in_registers=3, threads=32, locals=704),
        LargeLayout(lanes=8, in_registers=1, threads=64, locals=3584),
    ],
    ids=["chosen", "all kept", "turns", "much room"],
)
def test_every_layout_moves_blocks_as_the_recorded_kernels_do(layout, large):
    model, control = thrown_block(12, frames=3, clearance=8e-4)
    slow = recorded(model, "cuda:0").rollout(control)
    fast = large(model, layout=layout).rollout(control)
    assert np.abs(slow.position[-1] - slow.position[0]).max() > 0.005
    assert slow.position[..., 2].min() < 1e-3
    np.testing.assert_allclose(fast.position, slow.position, atol=2e-6)
    np.testing.assert_allclose(fast.velocity, slow.velocity, atol=2e-4)


@pytest.mark.gpu
def test_twenty_thousand_nodes_move_as_the_recorded_kernels_do_with_the_same_bits(large):
    model, control = thrown_block(28, frames=3)
    assert model.node_count > 20_000
    assert model.virtual_spring_count > 100
    simulator = large(model)
    fast = simulator.rollout(control)
    slow = recorded(model, "cuda:0").rollout(control)
    assert slow.position[..., 2].min() < 1e-3
    assert np.abs(slow.position[-1] - slow.position[0]).max() > 0.005
    np.testing.assert_allclose(fast.position, slow.position, atol=2e-6)
    np.testing.assert_allclose(fast.velocity, slow.velocity, atol=2e-4)
    for _ in range(20):
        again = simulator.rollout(control)
        assert np.array_equal(fast.position, again.position)
        assert np.array_equal(fast.velocity, again.velocity)


@pytest.mark.gpu
@pytest.mark.slow
def test_fifty_thousand_nodes_choose_this_kernel_and_few_do_not():
    import warp as wp

    if not wp.is_cuda_available():
        pytest.skip("needs a CUDA device")
    model, control = thrown_block(37, frames=2)
    simulator = Simulator(model, PARAMETERS, device="cuda:0")
    if simulator.engine is None:
        most = most_large_locals(simulator.device)
        pytest.skip(f"this device's blocks have room for {most} nodes only")
    assert simulator.engine.partition.most_locals > FORWARD_LOCALS
    assert simulator.engine.large is not None
    fast = simulator.rollout(control)
    slow = recorded(model, "cuda:0").rollout(control)
    assert slow.position[..., 2].min() < 1e-3
    np.testing.assert_allclose(fast.position, slow.position, atol=2e-6)
    assert Simulator(thrown_block(5)[0], PARAMETERS, device="cuda:0").engine.large is None


@pytest.mark.gpu
@pytest.mark.parametrize("in_registers", [1, 16])
def test_material_and_world_may_change_between_frames(in_registers, large):
    model, control = thrown_block(6, frames=4)
    layout = LargeLayout(lanes=1, in_registers=in_registers, threads=512, locals=1024)
    fast, slow = large(model, layout=layout), recorded(model, "cuda:0")
    ends = []
    for changes in (True, False):
        for simulator in (fast, slow):
            simulator.set_parameters(PARAMETERS)
            simulator.set_material(stiffness=model.stiffness, damping=model.damping)
            simulator.reset()
            simulator.step_frame(1, control[0], control[1])
            if changes:
                simulator.set_material(stiffness=2 * model.stiffness, damping=0.3 * model.damping)
            simulator.step_frame(2, control[1], control[2])
            if changes:
                simulator.set_parameters(PARAMETERS.replace(stiffness_scale=0.2, gravity=30.0))
            simulator.step_frame(3, control[2], control[3])
            ends.append(simulator.position.numpy())
    np.testing.assert_allclose(ends[0], ends[1], atol=2e-6)
    np.testing.assert_allclose(ends[2], ends[3], atol=2e-6)
    assert np.abs(ends[0] - ends[2]).max() > 1e-4


@pytest.mark.gpu
def test_divergence_names_the_same_substep(large):
    model, control = thrown_block(5)
    stiff = replace(model, stiffness=(model.stiffness * 3e4).astype(np.float32))
    told = []
    for simulator in (large(stiff), recorded(stiff, "cuda:0")):
        with pytest.raises(SimulationDivergedError) as caught:
            simulator.rollout(control)
        told.append((caught.value.frame, caught.value.substep))
    assert told[0] == told[1]


@pytest.mark.gpu
def test_gradients_go_the_recorded_way(large, monkeypatch):
    model, control = thrown_block(5, frames=3)
    monkeypatch.setattr(cuda, "ADJOINT_LOCALS", 0)
    theirs = block_gradients(model, control, PARAMETERS, "cuda:0")
    monkeypatch.undo()
    ours = block_gradients(model, control, PARAMETERS.replace(frame_rate=30.0 + 1e-9), "cuda:0")
    for name, value in theirs.items():
        assert np.abs(value).max() > 0
        error = np.linalg.norm(ours[name] - value) / np.linalg.norm(value)
        assert error < 2e-4, name


@pytest.mark.gpu
def test_a_tape_is_refused(large):
    model, _ = thrown_block(3)
    simulator = large(model)
    state = simulator.position, simulator.velocity
    with pytest.raises(ValueError, match="tape"):
        simulator.engine.advance(state, state, simulator.engine._no_tape)
