"""Candidates as bodies side by side: blocks as each would have alone, numbered in a row."""

import numpy as np
import pytest

from physhandi.simulation.engines.partition import Partition, partition_model
from physhandi.simulation.engines.side_by_side import MasterHalfEdges, join_partitions
from physhandi.simulation.master_topology import MasterTopology
from physhandi.simulation.parameters import SimulationParameters

NODES, CONTROLS = 60, 5
FIELDS = ("own_start", "model_node", "local_start", "local_node", "entry_start", "entry")


def master_of(parameters: list[SimulationParameters]) -> MasterTopology:
    rng = np.random.default_rng(3)
    node = rng.uniform(0.0, 0.1, (NODES, 3))
    return MasterTopology.of(node, rng.uniform(0.0, 0.1, (CONTROLS, 3)), parameters)


def candidates() -> list[SimulationParameters]:
    base = SimulationParameters(virtual_connection_radius=0.04, virtual_max_neighbors=9)
    return [
        base.replace(connection_radius=0.03, max_neighbors=5),
        base.replace(connection_radius=0.06, max_neighbors=30),
        base.replace(connection_radius=0.02, virtual_connection_radius=0.02),
    ]


@pytest.mark.parametrize("blocks", [2, 7])
def test_a_candidate_has_the_blocks_that_it_has_alone(blocks: int) -> None:
    drawn = candidates()
    master = master_of(drawn)
    edges = MasterHalfEdges(master, blocks)
    for parameters in drawn:
        ours = edges.of(master.has(parameters))
        theirs = partition_model(master.model(parameters), blocks)
        for name in FIELDS:
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), name)


def neighbors(part: Partition) -> list[set[tuple[int, int]]]:
    """List the other end and the spring of every half-edge of each of the model's nodes."""
    found: list[set[tuple[int, int]]] = [set() for _ in part.model_node]
    count = len(part.model_node)
    for block in range(part.block_count):
        local = part.local_node[part.local_start[block] : part.local_start[block + 1]]
        for node in range(part.own_start[block], part.own_start[block + 1]):
            for place, spring in part.entry[part.entry_start[node] : part.entry_start[node + 1]]:
                other = local[place]
                other = part.model_node[other] if other < count else other
                found[part.model_node[node]].add((int(other), int(spring)))
    return found


def test_joined_bodies_touch_only_themselves_and_the_controls() -> None:
    drawn = candidates()
    master = master_of(drawn)
    edges = MasterHalfEdges(master, 3)
    models = [master.model(parameters) for parameters in drawn]
    counts = [len(model.spring_nodes) for model in models]
    parts = [edges.of(master.has(parameters)) for parameters in drawn]
    joined = join_partitions(parts, NODES, counts)
    assert joined.block_count == 9
    found = neighbors(joined)
    first = 0
    for body, model in enumerate(models):
        wanted: list[set[tuple[int, int]]] = [set() for _ in range(NODES)]
        for spring, ends in enumerate(model.spring_nodes):
            for own, other in (ends, ends[::-1]):
                if own < NODES:
                    shift = NODES * body if other < NODES else NODES * (len(models) - 1)
                    wanted[own].add((int(other) + shift, first + spring))
        assert found[NODES * body : NODES * (body + 1)] == wanted
        assert sum(map(len, wanted)) > NODES
        first += counts[body]
