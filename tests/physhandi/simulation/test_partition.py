"""Blocks of nodes, against a plain loop over all springs."""

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest

from physhandi.simulation.engines.partition import bisect_nodes, group_springs, partition_model
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.topology import build_model


@pytest.fixture(scope="module")
def model():
    rng = np.random.default_rng(0)
    node, control = rng.uniform(0, 0.1, (300, 3)), rng.uniform(0, 0.1, (12, 3))
    parameters = SimulationParameters(virtual_connection_radius=0.03)
    return build_model(node.astype(np.float32), control.astype(np.float32), parameters)


@pytest.mark.parametrize("blocks", [1, 7, 300, 1000])
def test_every_spring_is_found_at_both_of_its_object_nodes(model, blocks):
    partition = partition_model(model, blocks)
    assert partition.block_count == min(blocks, 300)
    number = np.arange(312)
    number[partition.model_node] = np.arange(300)
    wanted = Counter(
        (number[a], number[b], spring)
        for spring, ends in enumerate(model.spring_nodes)
        for a, b in (ends, ends[::-1])
        if a < 300
    )
    found = Counter()
    for block in range(partition.block_count):
        first, last = partition.own_start[block : block + 2]
        local = partition.local_node[slice(*partition.local_start[block : block + 2])]
        assert np.array_equal(local[: last - first], np.arange(first, last))
        for node in range(first, last):
            for place, spring in partition.entry[slice(*partition.entry_start[node : node + 2])]:
                found[node, local[place], spring] += 1
    assert found == wanted
    assert len(wanted) == 2 * model.object_spring_count + model.virtual_spring_count
    assert model.virtual_spring_count > 0


def test_one_half_edge_speaks_for_each_spring(model):
    partition = partition_model(model, 5)
    spoken = partition.entry[partition.is_first == 1, 1]
    assert np.array_equal(np.sort(spoken), np.arange(len(model.spring_nodes)))


def test_blocks_are_equal_and_compact():
    grid = np.stack(np.meshgrid(*[np.arange(8.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    order, start = bisect_nodes(grid[np.random.default_rng(1).permutation(512)], 8)
    assert np.array_equal(np.sort(order), np.arange(512))
    assert np.array_equal(np.diff(start), np.full(8, 64))
    shuffled = grid[np.random.default_rng(1).permutation(512)]
    extents = [np.ptp(shuffled[order[a:b]], axis=0).max() for a, b in pairwise(start)]
    assert extents == [3.0] * 8


def test_a_model_without_springs_has_blocks_without_a_halo():
    parameters = SimulationParameters(connection_radius=0.001)
    model = build_model(np.eye(3, dtype=np.float32), np.zeros((0, 3), np.float32), parameters)
    partition = partition_model(model, 2)
    assert (partition.most_entries, partition.most_locals) == (0, partition.most_own)


@pytest.mark.parametrize("parts", [1, 2, 5, 1000])
def test_every_spring_is_with_the_parts_of_its_nodes(model, parts):
    grouped = group_springs(model, parts, 8)
    count = min(parts, 300)
    assert np.array_equal(np.sort(grouped.node), np.arange(300))
    part = np.repeat(np.arange(count), np.diff(grouped.own_start))
    place_node = np.concatenate([grouped.node, 300 + grouped.control, np.full(count, -1)])
    place_part = np.repeat(np.arange(count), np.diff(grouped.held_start))
    place_part = np.concatenate([part, place_part, np.arange(count)])
    assert len(place_node) == grouped.place_count
    for start, is_cut in ((grouped.inner_start, False), (grouped.cut_start, True)):
        assert len(start) == count + 1
        for index in range(count):
            here = slice(start[index], start[index + 1])
            assert (start[index + 1] - start[index]) % 8 == 0
            ends, spring = grouped.ends[here] // 4, grouped.spring[here]
            padding = spring == -1
            assert np.all(ends[padding] == grouped.held_start[-1] + index)
            ends, spring = ends[~padding], spring[~padding]
            assert np.array_equal(
                np.sort(place_node[ends], axis=1), np.sort(model.spring_nodes[spring], axis=1)
            )
            assert np.all(place_part[ends[:, 0]] == index)
            assert np.all((place_part[ends[:, 1]] == index) != is_cut)
            assert np.all(ends[:, 1] < 300) or not is_cut
    found = Counter(grouped.spring[grouped.spring >= 0].tolist())
    number = np.empty(300, dtype=int)
    number[grouped.node] = part
    first, second = model.spring_nodes.T
    is_cut = (second < 300) & (number[first] != number[np.minimum(second, 299)])
    assert is_cut.any() == (parts > 1)
    assert found == {index: 1 + cut for index, cut in enumerate(is_cut.tolist())}
    spoken = grouped.spoken[grouped.spoken >= 0]
    assert np.array_equal(np.sort(spoken), np.arange(len(model.spring_nodes)))


def test_springs_in_a_row_seldom_share_their_first_node(model):
    grouped = group_springs(model, 2, 8)
    ends = grouped.ends[: grouped.inner_start[1]]
    groups = ends[: len(ends) // 2 // 8 * 8, 0].reshape(-1, 8)
    assert all(len(set(group)) == 8 for group in groups.tolist())
