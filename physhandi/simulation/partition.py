"""How nodes are shared out to thread blocks that each own a compact part of the object."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Int32
from numpy import ndarray

from physhandi.simulation.model import SpringMassModel


@dataclass(frozen=True, kw_only=True, eq=False)
class Partition:
    """Blocks of nodes, the nodes beyond each block's border, and every node's half-edges.

    Nodes are numbered anew, block by block; control nodes follow as before.
    """

    own_start: Int32[ndarray, " block_1"]
    """First own node of each block, and the number of nodes."""
    model_node: Int32[ndarray, " node"]
    """Number in the model of each node."""
    local_start: Int32[ndarray, " block_1"]
    """Where each block's part of `local_node` begins."""
    local_node: Int32[ndarray, " local"]
    """Nodes that a block needs: its own ones in order, then its halo."""
    entry_start: Int32[ndarray, " node_1"]
    """Where each node's part of `entry` begins."""
    entry: Int32[ndarray, "half_edge 2"]
    """Half-edges: place of the other end in the block's part of `local_node`, and spring."""
    is_first: Int32[ndarray, " half_edge"]
    """Whether this half-edge speaks for its spring: one of the two does."""

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
    node: Float[ndarray, "node 3"], block_count: int
) -> tuple[Int[ndarray, " node"], Int[ndarray, " block_1"]]:
    """Cut a point set again and again across its longest side into blocks of equal size.

    Args:
        node: Positions [m].
        block_count: Number of blocks, at most the number of nodes.

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
        middle = begin + round((end - begin) * (blocks // 2) / blocks)
        cut(begin, middle, blocks // 2)
        cut(middle, end, blocks - blocks // 2)

    cut(0, len(node), block_count)
    return order, np.array(start)


def partition_model(model: SpringMassModel, block_count: int) -> Partition:
    """Share a model's nodes out to blocks.

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
    kept = np.flatnonzero(source < count)
    kept = kept[np.lexsort((other[kept], source[kept]))]
    source, other, spring, is_first = source[kept], other[kept], spring[kept], is_first[kept]

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
