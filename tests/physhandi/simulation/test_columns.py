"""Half-edges in reading order, against threads that read them one by one."""

from collections import Counter

import numpy as np
import pytest
import warp as wp
from reference.scenes import as_model, star_scene

from physhandi.simulation.engines.cuda import arrange_columns
from physhandi.simulation.engines.partition import partition_model
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.topology import build_model


def block_model(count):
    rng = np.random.default_rng(count)
    node, control = rng.uniform(0, 0.1, (count, 3)), rng.uniform(0, 0.1, (12, 3))
    parameters = SimulationParameters(virtual_connection_radius=0.03)
    return build_model(node.astype(np.float32), control.astype(np.float32), parameters)


def columns_of(partition, lanes, threads):
    """Give chunk count, starts, places and springs, as a processor arranges them."""
    tables = [
        wp.array(value, dtype=dtype, device="cpu")
        for value, dtype in (
            (partition.own_start, wp.int32),
            (partition.entry_start, wp.int32),
            (partition.entry, wp.vec2i),
        )
    ]
    columns = arrange_columns(partition, tables, lanes, threads)
    return columns.chunk_count, *(
        value.numpy() for value in (columns.start, columns.place, columns.spring)
    )


MODELS = {"block": block_model(300), "star": as_model(star_scene())[0]}


@pytest.mark.parametrize("lanes", [1, 2, 4, 8])
@pytest.mark.parametrize("threads", [32, 96, 768])
@pytest.mark.parametrize("name", MODELS)
def test_threads_find_each_half_edge_of_their_nodes_once(name, threads, lanes):
    model = MODELS[name]
    partition = partition_model(model, 3)
    chunks, start, place, spring = columns_of(partition, lanes, threads)
    rows = threads // lanes
    assert chunks == -(-partition.most_own // rows)
    read, padding = Counter(), 0
    for block in range(partition.block_count):
        first, last = partition.own_start[block : block + 2]
        for chunk in range(chunks):
            for thread in range(threads):
                group = (block * chunks + chunk) * (threads // 32) + thread // 32
                node = chunk * rows + thread // lanes
                for slot in range(start[group] + thread % 32, start[group + 1], 32):
                    if spring[slot] == -1:
                        assert place[slot] == min(node, last - first - 1)
                        padding += 1
                    else:
                        half_edge = place[slot], spring[slot]
                        read[first + node, *half_edge] += 1
    wanted = Counter(
        (node, *half_edge)
        for node in range(model.node_count)
        for half_edge in map(tuple, partition.entry[slice(*partition.entry_start[node : node + 2])])
    )
    assert len(wanted) > 0
    assert read == wanted
    assert padding + len(wanted) == len(place) == start[-1]


def test_threads_of_a_node_read_its_half_edges_in_turn():
    partition = partition_model(MODELS["block"], 1)
    _, _, place, _ = columns_of(partition, 4, 96)
    read = [place[k * 32 + lane] for k in range(20) for lane in range(4)]
    degree = partition.entry_start[1]
    assert degree > 8
    assert np.array_equal(read[:degree], partition.entry[:degree, 0])


def test_a_model_without_springs_has_no_columns():
    parameters = SimulationParameters(connection_radius=0.001)
    model = build_model(np.eye(3, dtype=np.float32), np.zeros((0, 3), np.float32), parameters)
    _, start, place, _ = columns_of(partition_model(model, 2), 8, 768)
    assert len(place) == 0
    assert np.all(start == 0)
    assert len(start) == 2 * 24 + 1
