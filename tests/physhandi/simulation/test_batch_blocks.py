"""Blocks that several candidates share: the springs of each, in an order without many conflicts."""

import numpy as np
import pytest
import warp as wp

from physhandi.simulation.engines.batch_blocks import GroupBlocks, share_blocks
from physhandi.simulation.engines.partition import bisect_nodes
from physhandi.simulation.kernels.batch.frame import GROUP_WIDTH, PHASE, TILE, arrange_entries

NODES, GROUPS, BLOCKS = 150, 2, 7


@pytest.fixture(name="scene", scope="module")
def _scene():
    """Draw nodes, springs between near ones, and which candidate has which spring."""
    rng = np.random.default_rng(5)
    node = rng.uniform(0.0, 0.1, (NODES, 3)).astype(np.float32)
    length = np.linalg.norm(node[:, None] - node, axis=2)
    springs = np.argwhere(np.triu(length < 0.03, 1))
    exists = rng.uniform(size=(GROUPS, GROUP_WIDTH, len(springs))) < 0.9
    exists[:, :, ::2] = True
    exists[1, :, :9] = False
    return springs, exists, GroupBlocks.of(node, springs, exists, BLOCKS)


def half_edges_of(blocks, row, place):
    """List node, other end and the candidates that have it, for half-edges by row."""
    block = np.searchsorted(TILE * blocks.tile_start, row, side="right") - 1
    local = row - TILE * blocks.tile_start[block]
    start = blocks.local_start[block]
    node = blocks.local_node[start + np.minimum(local, blocks.own_count[block] - 1)]
    other = blocks.local_node[start + (place & 0xFFFF) // (4 * GROUP_WIDTH)]
    has = ((place[:, None] >> (16 + np.arange(GROUP_WIDTH))) & 1) == 0
    return blocks.group[block], node, other, has


def test_each_candidate_has_its_springs_once_at_both_ends(scene):
    springs, exists, blocks = scene
    row = np.repeat(np.arange(len(blocks.count)) // (2 * PHASE), blocks.count)
    group, node, other, has = half_edges_of(blocks, row, blocks.place)
    for g in range(GROUPS):
        for candidate in range(GROUP_WIDTH):
            mine = (group == g) & has[:, candidate]
            found = sorted(zip(node[mine], other[mine], blocks.spring[mine], strict=True))
            part = np.flatnonzero(exists[g, candidate])
            ends = springs[part]
            wanted = [(i, j, s) for (i, j), s in zip(ends, part, strict=True)]
            wanted += [(j, i, s) for i, j, s in wanted]
            assert found == sorted(wanted)
            assert len(found) > NODES


def test_blocks_own_every_node_once_and_know_who_needs_it(scene):
    _, _, blocks = scene
    assert len(blocks.group) == BLOCKS
    for g in range(GROUPS):
        owned, needed, border = [], set(), set()
        for b in np.flatnonzero(blocks.group == g):
            local = blocks.local_node[blocks.local_start[b] : blocks.local_start[b + 1]]
            own = blocks.own_count[b]
            owned += local[:own].tolist()
            border |= set(local[: blocks.border_count[b]].tolist())
            needed |= set(local[own:].tolist())
        assert sorted(owned) == list(range(NODES))
        assert border == needed
        assert needed


def test_arranged_half_edges_are_the_same_and_conflict_less(scene):
    _, _, blocks = scene
    first = blocks.tile_first
    arranged = wp.zeros(int(first[-1]), dtype=wp.vec2i, device="cpu")

    def array(value):
        return wp.array(value.astype(np.int32), dtype=wp.int32, device="cpu")

    entry = np.stack([blocks.place, blocks.spring], axis=1).astype(np.int32)
    wp.launch(
        arrange_entries,
        dim=len(blocks.padding) // PHASE,
        inputs=[
            wp.array(entry, dtype=wp.vec2i, device="cpu"),
            array(blocks.first),
            array(first),
            array(blocks.tile_end),
            array(blocks.padding),
        ],
        outputs=[array(blocks.count), arranged],
        device="cpu",
    )
    place, spring = arranged.numpy().T
    slot = np.arange(len(place))
    tile = np.searchsorted(first, slot, side="right") - 1
    column = (slot - first[tile]) // TILE
    row = TILE * tile + (slot - first[tile]) % TILE
    is_real = place >> 16 != (1 << GROUP_WIDTH) - 1
    old_row = np.repeat(np.arange(len(blocks.count)) // (2 * PHASE), blocks.count)
    before = sorted(zip(old_row, blocks.place, blocks.spring, strict=True))
    after = zip(row[is_real], place[is_real], spring[is_real], strict=True)
    assert sorted(after) == before
    assert np.array_equal(place[~is_real], blocks.padding[row[~is_real]])
    # No candidate lacks what comes before the end of the certain columns.
    certain = column < blocks.tile_certain[tile]
    assert certain.any()
    assert not np.any(place[certain] >> 16)

    def reads(place):
        """Count the reads that the banks of each column of a phase ask for."""
        banks = ((place & 0xFFFF) // (4 * GROUP_WIDTH)).reshape(-1, PHASE)
        return np.mean([np.bincount(np.unique(each) % PHASE).max() for each in banks])

    rng = np.random.default_rng(0)
    random = 16 * rng.integers(0, 60, len(place))
    assert reads(place) < 0.8 * reads(random)


def test_blocks_are_shared_in_proportion_and_every_group_has_one():
    assert share_blocks([300, 100, 100], 10).tolist() == [6, 2, 2]
    assert share_blocks([1000, 1, 1], 4).tolist() == [2, 1, 1]
    assert share_blocks([5, 5, 5], 3).tolist() == [1, 1, 1]


def test_weighted_blocks_weigh_the_same():
    rng = np.random.default_rng(2)
    node = rng.uniform(size=(400, 3))
    weight = np.where(node[:, 0] < 0.5, 1.0, 5.0)
    order, start = bisect_nodes(node, 8, weight)
    assert sorted(order) == list(range(400))
    sizes = np.add.reduceat(weight[order], start[:-1])
    assert sizes.max() < 1.15 * sizes.mean()
    assert np.ptp(np.diff(start)) > 20
    # However uneven, each block has a node.
    _, start = bisect_nodes(node[:8], 8, np.array([100.0, *np.ones(7)]))
    assert np.diff(start).tolist() == [1] * 8
