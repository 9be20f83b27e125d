"""Losses added up beside the states, against the same sums in float64."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree

from physhandi.simulation.engines.batch import BatchSimulator, MotionTarget
from physhandi.simulation.master_topology import MasterTopology
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator

BASE = SimulationParameters(damping=2.0, substeps_per_frame=60, ground_height=0.0)
FRAMES = 4


def scene():
    """Give a block that two controls pull, and where it was seen."""
    rng = np.random.default_rng(2)
    axis = 0.01 * np.arange(3)
    node = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    node = (node + rng.normal(0, 4e-4, node.shape)).astype(np.float32)
    path = np.linspace(0, 1, FRAMES)[:, None, None] * np.array([0.006, -0.003, 0.004])
    control = (node[[2, 8]] + np.array([0, 0, 0.004]) + path).astype(np.float32)
    return node, control


def target(node, *, points=11, tracks=5, **more):
    rng = np.random.default_rng(3)
    carrier = rng.integers(0, len(node), (tracks, 3))
    weight = rng.uniform(0.1, 1.0, carrier.shape)
    settings = {
        "cloud": rng.normal(0.01, 0.01, (FRAMES, points, 3)),
        "cloud_weight": rng.uniform(0, 1, (FRAMES, points)) * (rng.uniform(size=points) < 0.8),
        "surface_count": None,
        "track": rng.normal(0.01, 0.01, (FRAMES, tracks, 3)),
        "track_weight": rng.uniform(0, 1, (FRAMES, tracks)),
        "carrier": carrier,
        "carrier_weight": weight / weight.sum(axis=1, keepdims=True),
        "track_offset": rng.normal(0, 0.002, (tracks, 3)),
    }
    return MotionTarget(**(settings | more))


def oracle(seen, position, velocity):
    """Add the same terms up with SciPy's tree and NumPy, in float64."""
    total = 0.0
    for frame in range(1, FRAMES):
        node = position[frame].astype(np.float64)
        distance = KDTree(node[: seen.surface_count]).query(seen.cloud[frame])[0]
        total += float(seen.cloud_weight[frame] @ distance**2)
        carried = np.einsum("tck,tc->tk", node[seen.carrier], seen.carrier_weight)
        missed = carried + seen.track_offset - seen.track[frame]
        total += float(seen.track_weight[frame] @ (missed**2).sum(axis=1))
        if frame > 1:
            speed = velocity.astype(np.float64)
            jerk = np.abs(speed[frame] - 2 * speed[frame - 1] + speed[frame - 2])
            value = np.where(jerk < 1.0, 0.5 * jerk**2, jerk - 0.5)
            total += seen.acceleration_weight * float(value.mean())
    return total / (FRAMES - 1)


def candidates(count):
    rng = np.random.default_rng(4)
    return [
        BASE.replace(
            connection_radius=rng.uniform(0.011, 0.02),
            virtual_connection_radius=rng.uniform(0.006, 0.02),
            stiffness=rng.uniform(50, 250),
            drag=rng.uniform(0, 9),
        )
        for _ in range(count)
    ]


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"surface_count": 9},
        {"acceleration_weight": 0.01},
        {"points": 0},
        {"tracks": 0},
        {"points": 8, "tracks": 1},
    ],
)
def test_losses_are_the_sums_of_their_terms(device, more):
    node, control = scene()
    drawn = candidates(3)
    seen = target(node, **more)
    master = MasterTopology.of(node, control[0], drawn)
    simulator = BatchSimulator(master, drawn, device)
    found = simulator.losses(control, seen)
    assert np.all(found.diverged_frame == -1)
    for candidate, parameters in enumerate(drawn):
        alone = Simulator(master.model(parameters), parameters, device).rollout(control)
        wanted = oracle(seen, alone.position, alone.velocity)
        assert wanted > 1e-5
        assert found.loss[candidate] == pytest.approx(wanted, rel=2e-5)
    assert len(np.unique(found.loss)) == 3
    again = simulator.losses(control, seen)
    np.testing.assert_array_equal(again.loss, found.loss)


def test_the_acceleration_term_is_not_lost_among_the_others(device):
    node, control = scene()
    drawn = candidates(2)
    master = MasterTopology.of(node, control[0], drawn)
    nothing = target(node, points=0, tracks=0)
    silent = BatchSimulator(master, drawn, device).losses(control, nothing)
    np.testing.assert_array_equal(silent.loss, 0.0)
    rough = replace(nothing, acceleration_weight=1.0)
    assert np.all(BatchSimulator(master, drawn, device).losses(control, rough).loss > 1e-6)


def test_a_candidate_that_diverges_has_an_infinite_loss_and_the_others_theirs(device):
    node, control = scene()
    drawn = candidates(3)
    wild = [drawn[0], drawn[1].replace(stiffness=1e8), drawn[2]]
    seen = target(node)
    tame = BatchSimulator(MasterTopology.of(node, control[0], drawn), drawn, device)
    found = BatchSimulator(MasterTopology.of(node, control[0], wild), wild, device)
    tame, found = tame.losses(control, seen), found.losses(control, seen)
    assert np.isinf(found.loss[1])
    assert found.diverged_frame[1] == 1
    np.testing.assert_array_equal(found.loss[[0, 2]], tame.loss[[0, 2]])
    assert np.all(np.isfinite(found.loss[[0, 2]]))


def test_a_trajectory_that_ends_too_soon_is_refused(device):
    node, control = scene()
    drawn = candidates(1)
    simulator = BatchSimulator(MasterTopology.of(node, control[0], drawn), drawn, device)
    with pytest.raises(ValueError, match="3 frames, but 4 were observed"):
        simulator.losses(control[:3], target(node))
    bad = control.copy()
    bad[2, 1] = np.nan
    with pytest.raises(ValueError, match="not finite at frame 2, node 1"):
        simulator.losses(bad, target(node))
