"""Partitions of an object: compact blocks of nodes for CUDA, parts of springs for the CPU."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Int32
from numpy import ndarray

from physhandi.simulation.model import SpringMassModel


@dataclass(frozen=True, kw_only=True, eq=False)
class Partition:
    """Blocks of nodes, each block's halo, and every node's half-edges.

    Nodes are renumbered block by block; control nodes follow in their order.
    """

    own_start: Int32[ndarray, " block_1"]
    """First own node of each block, and the number of nodes."""
    model_node: Int32[ndarray, " node"]
    """Number in the model of each node."""
    local_start: Int32[ndarray, " block_1"]
    """Start of each block's part of `local_node`."""
    local_node: Int32[ndarray, " local"]
    """Nodes that a block needs: its own ones in order, then its halo."""
    entry_start: Int32[ndarray, " node_1"]
    """Start of each node's part of `entry`."""
    entry: Int32[ndarray, "half_edge 2"]
    """Half-edges: place of the other end in the block's part of `local_node`, and spring."""
    is_first: Int32[ndarray, " half_edge"]
    """Whether this half-edge writes the derivatives of its spring; one of the two does."""

    @property
    def block_count(self) -> int:
        """Number of blocks."""
        return len(self.own_start) - 1

    @property
    def most_own(self) -> int:
        """Most nodes that a block owns."""
        return int(np.diff(self.own_start).max())

    @property
    def most_locals(self) -> int:
        """Most nodes that a block needs, its own ones included."""
        return int(np.diff(self.local_start).max())

    @property
    def most_entries(self) -> int:
        """Most springs at one node."""
        return int(np.diff(self.entry_start).max(initial=0))


def bisect_nodes(
    node: Float[ndarray, "node 3"],
    block_count: int,
    weight: Float[ndarray, " node"] | None = None,
) -> tuple[Int[ndarray, " node"], Int[ndarray, " block_1"]]:
    """Bisect a point set recursively across its longest side into blocks of equal size.

    Args:
        node: Positions [m].
        block_count: Number of blocks, at most the number of nodes.
        weight: What each node adds to the size of its block; 1 if left out. A block has a node.

    Returns:
        The nodes block by block, and where each block begins.
    """
    order = np.arange(len(node))
    start = [0]

    def cut(begin: int, end: int, blocks: int) -> None:
        if blocks == 1:
            order[begin:end] = np.sort(order[begin:end])
            start.append(end)
            return
        part = order[begin:end]
        axis = int(np.ptp(node[part], axis=0).argmax())
        order[begin:end] = part[np.argsort(node[part, axis], kind="stable")]
        if weight is None:
            middle = begin + round((end - begin) * (blocks // 2) / blocks)
        else:
            total = np.cumsum(weight[order[begin:end]])
            share = total[-1] * (blocks // 2) / blocks
            middle = begin + int(np.searchsorted(total, share))
            middle = min(max(middle, begin + blocks // 2), end - (blocks - blocks // 2))
        cut(begin, middle, blocks // 2)
        cut(middle, end, blocks - blocks // 2)

    cut(0, len(node), block_count)
    return order, np.array(start)


def partition_model(model: SpringMassModel, block_count: int) -> Partition:
    """Partition a model's nodes into blocks.

    Args:
        model: Nodes and springs; there must be a node.
        block_count: Number of blocks; no more than nodes are made.
    """
    count = model.node_count
    blocks = min(block_count, count)
    order, own_start = bisect_nodes(model.object_node, blocks)
    number = np.arange(count + model.control_count)
    number[order] = np.arange(count)
    springs = np.arange(len(model.spring_nodes))
    ends = number[model.spring_nodes]
    source, other = np.concatenate([ends, ends[:, ::-1]]).T
    spring = np.concatenate([springs, springs])
    is_object = spring < model.object_spring_count
    is_first = np.concatenate([springs >= 0, springs < 0]) | ~is_object
    own = np.flatnonzero(source < count)
    own = own[np.lexsort((other[own], source[own]))]
    source, other, spring, is_first = source[own], other[own], spring[own], is_first[own]

    block = np.repeat(np.arange(blocks), np.diff(own_start))
    is_beyond = (other >= count) | (block[np.minimum(other, count - 1)] != block[source])
    width = count + model.control_count
    halo = np.unique(block[source[is_beyond]] * width + other[is_beyond])
    halo_block, halo_node = np.divmod(halo, width)
    halo_count = np.bincount(halo_block, minlength=blocks)
    halo_start = np.concatenate([[0], np.cumsum(halo_count)])
    own_count = np.diff(own_start)
    local = np.where(is_beyond, 0, other - own_start[block[source]])
    beyond = block[source[is_beyond]]
    place = np.searchsorted(halo, beyond * width + other[is_beyond]) - halo_start[beyond]
    local[is_beyond] = own_count[beyond] + place
    own_parts = np.split(np.arange(count), own_start[1:-1])
    halo_parts = np.split(halo_node, halo_start[1:-1])
    parts = [part for pair in zip(own_parts, halo_parts, strict=True) for part in pair]
    return Partition(
        own_start=own_start.astype(np.int32),
        model_node=order.astype(np.int32),
        local_start=np.concatenate([[0], np.cumsum(own_count + halo_count)]).astype(np.int32),
        local_node=np.concatenate(parts).astype(np.int32),
        entry_start=np.searchsorted(source, np.arange(count + 1)).astype(np.int32),
        entry=np.stack([local, spring], axis=1).astype(np.int32),
        is_first=is_first.astype(np.int32),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class SpringParts:
    """Parts of the object with all their springs, in groups for a processor's vector unit.

    Places are the nodes part by part, then the control nodes that each part's springs pull at,
    then one empty place for each part, to which the springs that pad its lists are tied.
    """

    own_start: Int32[ndarray, " part_1"]
    """First own node of each part, and the number of nodes."""
    held_start: Int32[ndarray, " part_1"]
    """Place of the first control node of each part, and of the first empty place."""
    inner_start: Int32[ndarray, " part_1"]
    """First of each part's springs that pull at nothing of another part."""
    cut_start: Int32[ndarray, " part_1"]
    """First of each part's springs to a node of another part; its own node comes first."""
    node: Int32[ndarray, " node"]
    """Number in the model of the node in each place."""
    control: Int32[ndarray, " held"]
    """Which control node is in each place."""
    spring: Int32[ndarray, " entry"]
    """Which spring of the model each is; -1 for padding."""
    spoken: Int32[ndarray, " entry"]
    """The same, but -1 also where the other part writes the derivatives of a cut spring."""
    ends: Int32[ndarray, "entry 2"]
    """Four times the place of each end."""

    @property
    def place_count(self) -> int:
        """Number of places."""
        return int(self.held_start[-1]) + len(self.own_start) - 1


def group_springs(model: SpringMassModel, part_count: int, group: int) -> SpringParts:
    """Partition a model's nodes and springs into a few parts.

    Args:
        model: Nodes and springs; there must be a node.
        part_count: Number of parts, reduced to the number of nodes if larger.
        group: Springs that are computed at once; lists are padded to a multiple.
    """
    count = model.node_count
    parts = min(part_count, count)
    order, own_start = bisect_nodes(model.object_node, parts)
    number = np.arange(count + model.control_count)
    number[order] = np.arange(count)
    part = np.repeat(np.arange(parts), np.diff(own_start))
    ends = np.sort(number[model.spring_nodes], axis=1)
    is_held = ends[:, 1] >= count
    home = part[ends[:, 0]]
    away = np.where(is_held, home, part[np.minimum(ends[:, 1], count - 1)])

    # Each part has its own places for the control nodes that it needs.
    width = len(number)
    held_keys, place = np.unique(home[is_held] * width + ends[is_held, 1], return_inverse=True)
    ends[is_held, 1] = count + place.reshape(-1)
    held_start = count + np.searchsorted(held_keys, np.arange(parts + 1) * width)

    springs = np.arange(len(ends))
    inner = [springs[(home == index) & (away == index)] for index in range(parts)]
    near = [springs[(home == index) & (away != index)] for index in range(parts)]
    far = [springs[(home != index) & (away == index)] for index in range(parts)]
    lists = [np.column_stack([ends[spring], spring, spring]) for spring in inner]
    # A part's own node is the first end of a cut spring; only one part writes its derivatives.
    lists += [
        np.vstack(
            [
                np.column_stack([ends[own], own, own]),
                np.column_stack([ends[other, ::-1], other, np.full(len(other), -1)]),
            ]
        )
        for own, other in zip(near, far, strict=True)
    ]
    padded = []
    for index, entries in enumerate(lists):
        empty = held_start[-1] + index % parts
        padding = np.tile([empty, empty, -1, -1], (-len(entries) % group, 1))
        padded.append(np.vstack([entries[_spread(entries[:, :2])], padding]))
    start = np.concatenate([[0], np.cumsum([len(entries) for entries in padded])])
    entry = np.concatenate(padded).astype(np.int32)
    return SpringParts(
        own_start=own_start.astype(np.int32),
        held_start=held_start.astype(np.int32),
        inner_start=start[: parts + 1].astype(np.int32),
        cut_start=start[parts:].astype(np.int32),
        node=order.astype(np.int32),
        control=(held_keys % width - count).astype(np.int32),
        spring=entry[:, 2].copy(),
        spoken=entry[:, 3].copy(),
        ends=4 * entry[:, :2],
    )


def _spread(pairs: Int[ndarray, "spring 2"]) -> Int[ndarray, " spring"]:
    """Order springs so that neighbours in the list seldom share a node.

    Consecutive additions to one node depend on each other; spreading them keeps the processor busy.
    """
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    first = pairs[order, 0]
    rank = np.arange(len(order)) - np.searchsorted(first, first)
    return order[np.lexsort((first, rank))]
