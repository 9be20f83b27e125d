"""Many candidates at once, against one simulation for each."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from physhandi.errors import UsageError
from physhandi.simulation.engines import batch
from physhandi.simulation.engines.batch import BatchSimulator, Population
from physhandi.simulation.kernels.batch.substep import BLOCK_NODES
from physhandi.simulation.master_topology import MasterTopology
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.topology import build_model

WAYS = ["side by side", "in blocks", "interleaved"]
BASE = SimulationParameters(damping=2.0, substeps_per_frame=120, ground_height=0.0)


def candidates(count, seed=0):
    """Draw parameters that differ in every scalar and in topology."""
    rng = np.random.default_rng(seed)
    return [
        BASE.replace(
            connection_radius=rng.uniform(0.011, 0.02),
            max_neighbors=int(rng.integers(2, 20)),
            virtual_connection_radius=rng.uniform(0.002, 0.02),
            virtual_max_neighbors=int(rng.integers(1, 8)),
            stiffness=rng.uniform(50, 250),
            virtual_stiffness=rng.uniform(50, 200),
            stiffness_scale=rng.uniform(0.5, 1.5),
            damping=rng.uniform(0.5, 3),
            drag=rng.uniform(0, 9),
            restitution=rng.uniform(0, 1),
            friction=rng.uniform(0, 2),
            gravity=rng.uniform(5, 12),
            use_control_velocity=bool(rng.integers(2)),
        )
        for _ in range(count)
    ]


def scene(side=5, seed=1):
    """Drop a block of nodes that some controls pull, on the ground."""
    rng = np.random.default_rng(seed)
    axis = 0.01 * np.arange(side)
    node = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    node = (node + rng.normal(0, 4e-4, node.shape) + np.array([0, 0, 0.002])).astype(np.float32)
    control = node[node[:, 2] > axis[-1]][::4] + np.array([0, 0, 0.004], dtype=np.float32)
    path = np.linspace(0, 1, 4)[:, None, None] * np.array([0.006, -0.003, 0.004])
    velocity = rng.normal(0, 0.03, node.shape) + np.array([0.1, 0.0, -0.3])
    return node, (control + path).astype(np.float32), velocity.astype(np.float32)


def clearance_of(node):
    """Let two thirds of the nodes touch the ground at 0.8 and 1.6 mm above it."""
    return (8e-4 * (np.arange(len(node)) % 3)).astype(np.float32)


def master_of(node, control, drawn, velocity):
    return MasterTopology.of(
        node, control[0], drawn, initial_velocity=velocity, clearance=clearance_of(node)
    )


def alone(parameters, node, control, velocity, device):
    model = build_model(node, control[0], parameters)
    model = replace(model, initial_velocity=velocity, clearance=clearance_of(node))
    return Simulator(model, parameters, device=device).rollout(control).position


def simulator_of(way, master, drawn, device):
    """Make what moves the candidates in one of the ways that there are on CUDA."""
    if way != "in blocks":
        side_by_side = way == "side by side"
        return BatchSimulator(master, drawn, device=device, side_by_side=side_by_side)
    substeps = max(p.substeps_per_frame for p in drawn)
    population = Population(master, tuple(drawn), substeps, wp.get_device(device), in_blocks=True)
    assert population.blocks is not None
    return population


def test_a_candidate_has_the_springs_that_it_would_find_itself():
    node, control, _ = scene()
    drawn = candidates(25, seed=3)
    master = MasterTopology.of(node, control[0], drawn)
    counts = set()
    for parameters in drawn:
        ours, theirs = master.model(parameters), build_model(node, control[0], parameters)
        assert np.array_equal(ours.spring_nodes, theirs.spring_nodes)
        np.testing.assert_array_equal(ours.rest_length, theirs.rest_length)
        np.testing.assert_array_equal(ours.stiffness, theirs.stiffness)
        counts.add(len(ours.spring_nodes))
    assert len(counts) > 15
    assert min(counts) > 0


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("count", [1, 32, 45])
def test_each_candidate_moves_as_if_it_were_alone(device, count, way):
    if device == "cpu" and way != "side by side":
        pytest.skip("candidates on a CPU take turns either way")
    node, control, velocity = scene()
    drawn = candidates(count)
    master = master_of(node, control, drawn, velocity)
    moved = simulator_of(way, master, drawn, device).rollout(control)
    assert moved.position.shape == (count, 4, len(node), 3)
    assert np.all(moved.diverged_frame == -1)
    for candidate in range(0, count, 1 if device == "cpu" and count < 4 else 7):
        wanted = alone(drawn[candidate], node, control, velocity, device)
        assert np.abs(wanted[-1] - wanted[0]).max() > 0.003
        np.testing.assert_allclose(moved.position[candidate], wanted, atol=2e-6)
    if count > 1:
        assert np.abs(moved.position[0] - moved.position[1]).max() > 1e-4


@pytest.mark.gpu
@pytest.mark.parametrize("side_by_side", [True, False])
@pytest.mark.parametrize("side", [3, 9, 13])
def test_sizes_that_fit_shared_memory_in_different_ways(side, side_by_side):
    _needs_cuda()
    node, control, velocity = scene(side)
    drawn = [p.replace(connection_radius=0.03, max_neighbors=60) for p in candidates(3)]
    master = master_of(node, control, drawn, velocity)
    moved = BatchSimulator(master, drawn, "cuda:0", side_by_side=side_by_side).rollout(control)
    for candidate, parameters in enumerate(drawn):
        wanted = alone(parameters, node, control, velocity, "cuda:0")
        np.testing.assert_allclose(moved.position[candidate], wanted, atol=5e-6)


@pytest.mark.gpu
@pytest.mark.parametrize("side_by_side", [True, False])
def test_a_node_with_more_neighbors_than_fit_is_simulated_too(side_by_side):
    _needs_cuda()
    rng = np.random.default_rng(4)
    node = rng.uniform(0, 0.05, (500, 3)).astype(np.float32)
    still = np.zeros((3, 0, 3), np.float32)
    drawn = [
        BASE.replace(connection_radius=0.2, max_neighbors=499, stiffness=s, damping=0.05)
        for s in (0.05, 0.2)
    ]
    master = master_of(node, still, drawn, np.zeros_like(node))
    moved = BatchSimulator(master, drawn, "cuda:0", side_by_side=side_by_side).rollout(still)
    wanted = alone(drawn[1], node, still, np.zeros_like(node), "cuda:0")
    assert np.abs(wanted[-1] - wanted[0]).max() > 1e-3
    np.testing.assert_allclose(moved.position[1], wanted, atol=5e-6)


@pytest.mark.gpu
def test_candidates_of_a_large_object_share_blocks():
    _needs_cuda()
    node, control, velocity = scene(14)
    # Without the ground: whoever just touches it moves on otherwise after a rounding.
    drawn = [p.replace(ground_height=None) for p in candidates(62)]
    master = master_of(node, control, drawn, velocity)
    simulator = BatchSimulator(master, drawn, "cuda:0")
    moved = simulator.rollout(control)
    assert isinstance(simulator._population, Population)
    blocks = simulator._population.blocks
    assert blocks is not None
    for candidate in range(0, 62, 9):
        wanted = alone(drawn[candidate], node, control, velocity, "cuda:0")
        np.testing.assert_allclose(moved.position[candidate], wanted, atol=5e-6)
    # The same bits again, also once tags begin again.
    blocks._relay._tag = 2**31 - 2**20 - 100
    for _ in range(2):
        again = simulator.rollout(control)
        assert np.array_equal(again.position, moved.position)
    assert blocks._relay._tag < 10_000


@pytest.mark.gpu
def test_a_thousand_candidates_at_once():
    _needs_cuda()
    node, control, velocity = scene(3)
    drawn = candidates(1000)
    master = master_of(node, control, drawn, velocity)
    simulator = BatchSimulator(master, drawn, device="cuda:0")
    moved = simulator.rollout(control)
    for candidate in (0, 499, 999):
        wanted = alone(drawn[candidate], node, control, velocity, "cuda:0")
        np.testing.assert_allclose(moved.position[candidate], wanted, atol=2e-6)
    again = simulator.rollout(control)
    assert np.array_equal(again.position, moved.position)


@pytest.mark.gpu
@pytest.mark.parametrize("substeps", [120, 121])
def test_parts_of_a_large_batch_move_one_after_the_other_to_the_same_bits(monkeypatch, substeps):
    _needs_cuda()
    node, control, velocity = scene(6)
    drawn = [
        p.replace(substeps_per_frame=substeps, ground_height=None if index % 2 else 0.0)
        for index, p in enumerate(candidates(1000))
    ]
    master = master_of(node, control, drawn, velocity)
    found = {}
    for cached in (0.0, 1e9):
        monkeypatch.setattr(batch, "_CACHED_BYTES", cached)
        simulator = BatchSimulator(master, drawn, device="cuda:0", side_by_side=False)
        found[cached] = simulator.rollout(control).position
        parts = len(simulator._population._frame_graphs)
        assert parts == (16 if cached == 0.0 else 1)
    assert np.array_equal(found[0.0], found[1e9])
    for candidate in (0, 501, 998, 999):
        wanted = alone(drawn[candidate], node, control, velocity, "cuda:0")
        np.testing.assert_allclose(found[0.0][candidate], wanted, atol=2e-6)


@pytest.mark.parametrize("count", [1, 16, 17, 1000])
def test_nodes_of_a_block_of_threads_lie_together(count):
    node = np.random.default_rng(0).permutation(scene(10)[0])[:count]
    order = batch._in_blocks(node)
    assert sorted(order) == list(range(count))
    if count == 1000:
        for block in np.split(order, range(BLOCK_NODES, count, BLOCK_NODES)):
            assert np.ptp(node[block], axis=0).max() < 0.05 < np.ptp(node, axis=0).min()


@pytest.mark.parametrize("way", WAYS)
def test_a_candidate_that_diverges_does_not_harm_the_others(device, way):
    if device == "cpu" and way != "side by side":
        pytest.skip("candidates on a CPU take turns either way")
    node, control, velocity = scene()
    drawn = candidates(5)
    drawn[2] = drawn[2].replace(stiffness=1e7, connection_radius=0.02, max_neighbors=19)
    master = master_of(node, control, drawn, velocity)
    moved = simulator_of(way, master, drawn, device).rollout(control)
    assert moved.diverged_frame[2] >= 1
    assert np.all(np.delete(moved.diverged_frame, 2) == -1)
    for candidate in (0, 4):
        wanted = alone(drawn[candidate], node, control, velocity, device)
        np.testing.assert_allclose(moved.position[candidate], wanted, atol=2e-6)


@pytest.mark.parametrize("way", WAYS)
def test_each_candidate_has_its_own_speed_limit(device, way):
    if device == "cpu" and way != "side by side":
        pytest.skip("candidates on a CPU take turns either way")
    node, control, velocity = scene()
    drawn = candidates(5)
    master = master_of(node, control, drawn, velocity)
    moved = simulator_of(way, master, drawn, device).rollout(control)
    # The mean over a frame: some substep exceeds half of it, and none ten times as much.
    speed = 30.0 * np.linalg.norm(np.diff(moved.position, axis=1), axis=-1).max(axis=(1, 2))
    assert np.all(speed > 0.1)
    limits = speed * [10.0, 0.5, 100.0, 0.2, 1000.0]
    drawn = [p.replace(speed_limit=float(s)) for p, s in zip(drawn, limits, strict=True)]
    again = simulator_of(way, master, drawn, device).rollout(control)
    assert np.array_equal(again.diverged_frame >= 0, [False, True, False, True, False])
    slow = [0, 2, 4]
    np.testing.assert_array_equal(again.position[slow], moved.position[slow])


def test_what_must_be_common_and_what_a_batch_cannot_do_are_refused():
    node, control, _ = scene(3)
    master = MasterTopology.of(node, control[0], [BASE])
    with pytest.raises(UsageError, match="at least one"):
        BatchSimulator(master, [])
    with pytest.raises(UsageError, match="rest_length_floor"):
        BatchSimulator(master, [BASE, BASE.replace(rest_length_floor=2e-3)])
    with pytest.raises(UsageError, match=r"[Ss]elf-collision"):
        BatchSimulator(master, [BASE.replace(self_collision=True)])
    with pytest.raises(UsageError, match="hand_pushes"):
        BatchSimulator(master, [BASE.replace(hand_pushes=True)])
    with pytest.raises(ValueError, match="control"):
        BatchSimulator(master, [BASE]).rollout(control[:, :1])


def _needs_cuda():
    if not wp.is_cuda_available():
        pytest.skip("needs a CUDA device")
