"""Substeps for all candidates of a search at once, against blocks of float64 matrices."""

import math

import numpy as np
import pytest

from physhandi.simulation.engines.batch_substeps import bound_substeps
from physhandi.simulation.master_topology import MasterTopology
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.stability import stable_substeps


def candidates_of(seed, count=7):
    rng = np.random.default_rng(seed)
    return [
        SimulationParameters(
            frame_rate=1.0,
            connection_radius=rng.uniform(0.3, 0.6),
            max_neighbors=int(rng.integers(4, 20)),
            virtual_connection_radius=rng.uniform(0.1, 0.4),
            virtual_max_neighbors=int(rng.integers(1, 6)),
            stiffness=10 ** rng.uniform(2, 4),
            virtual_stiffness=10 ** rng.uniform(2, 4),
            damping=rng.choice([0.0, rng.uniform(1, 60)]),
            rest_length_floor=0.15,
            virtual_rest_length_floor=0.08,
        )
        for _ in range(count)
    ]


def body_of(seed):
    rng = np.random.default_rng(100 + seed)
    node = rng.uniform(-0.5, 0.5, (40, 3)).astype(np.float32)
    return node, node[:5] + rng.normal(0, 0.05, (5, 3))


def load_by_hand(model, rate):
    """Twice the largest eigenvalue of a node's block, and its springs to control nodes."""
    place, own = model.object_node.astype(float), model.object_spring_count
    block = np.zeros((model.node_count, 3, 3))
    held = np.zeros(model.node_count)
    for number, (i, j) in enumerate(model.spring_nodes):
        if number < own:
            along = (place[j] - place[i]) / np.linalg.norm(place[j] - place[i])
            for end in (i, j):
                block[end] += rate[number] * np.outer(along, along)
        else:
            held[min(i, j)] += rate[number]
    return float((2.0 * np.linalg.eigvalsh(block)[:, -1] + held).max())


@pytest.mark.parametrize("seed", range(3))
def test_bounds_are_those_of_dense_blocks(seed, device):
    node, control = body_of(seed)
    candidates = candidates_of(seed)
    master = MasterTopology.of(node, control, candidates)
    expected = []
    for parameters in candidates:
        model = master.model(parameters)
        assert model.object_spring_count > 40
        assert model.virtual_spring_count > 2
        stiffness = load_by_hand(model, model.stiffness.astype(float) / model.rest_length)
        damping = load_by_hand(model, model.damping.astype(float))
        # dt² k + 2 dt c = 4.
        step = max(np.roots([stiffness, 2.0 * damping, -4.0]).real)
        expected.append(math.ceil(1.25 / (parameters.frame_rate * step)))
    assert bound_substeps(master, candidates, device) == expected
    assert len(set(expected)) > 4
    assert min(expected) > 50


@pytest.mark.parametrize("seed", range(6))
def test_a_bound_is_never_below_what_is_needed(seed):
    node, control = body_of(seed)
    candidates = candidates_of(seed)
    master = MasterTopology.of(node, control, candidates)
    for bound, parameters in zip(
        bound_substeps(master, candidates, "cpu"), candidates, strict=True
    ):
        needed = stable_substeps(master.model(parameters), parameters)
        assert needed > 50
        assert needed <= bound <= 3 * needed


def test_the_bound_is_that_of_the_stiffest_direction_of_a_node(device):
    # From the corner, springs of 1 m lead along x, y and z and springs of √2 m in between, of
    # 100 N each. Along x + y + z each of the former has 100/3 N/m and each of the latter
    # 100/√2 · 2/3: 100 + 100 √2 in all, more than in the other directions and at the other nodes.
    # The hand's spring of 0.5 m and 300 N, 600 N/m, counts in full.
    node = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, 1], [0, 1, 1]])
    soft = SimulationParameters(
        frame_rate=1.0,
        connection_radius=1.5,
        max_neighbors=30,
        virtual_connection_radius=0.6,
        virtual_max_neighbors=1,
        stiffness=100.0,
        virtual_stiffness=300.0,
        damping=0.0,
    )
    near = soft.replace(connection_radius=1.1, virtual_connection_radius=0.4)
    scaled = near.replace(stiffness_scale=9.0)
    damped = near.replace(damping=50.0)
    loose = near.replace(stiffness=0.0, damping=50.0)
    candidates = [soft, near, scaled, damped, loose]
    master = MasterTopology.of(node, np.array([[-0.5, 0, 0]]), candidates)
    bounds = bound_substeps(master, candidates, device, safety=1000.0)
    # Without damping a step is 2 / √k; in `near` each of x, y and z has 100 N/m.
    corner = 2 * (100 + 100 * math.sqrt(2)) + 600
    assert bounds[0] == math.ceil(1000 * math.sqrt(corner) / 2)
    assert bounds[1] == math.ceil(1000 * math.sqrt(200) / 2)
    assert bounds[2] == math.ceil(1000 * math.sqrt(1800) / 2)
    # dt² k + 2 dt c = 4 with k = 200 and c = 2 · 50.
    assert bounds[3] == math.ceil(1000 * 400 / (math.sqrt(4 * 100**2 + 16 * 200) - 200))
    assert bounds[4] == 1  # Nothing is stiff, so nothing is damped either.
