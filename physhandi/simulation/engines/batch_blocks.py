"""Cuts groups of candidates of a large object into blocks that one launch moves by a frame.

`GroupBlocks` says which nodes and half-edges each block has, `BatchBlocks` holds them on the device
for `kernels.batch.frame`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Bool, Float32, Int
from numpy import ndarray

from physhandi.simulation.engines.cuda import BYTES_OF_A_THREAD, LEAST_OWN, Relay
from physhandi.simulation.engines.partition import bisect_nodes
from physhandi.simulation.kernels.batch.frame import (
    BYTES_OF_A_BLOCK,
    BYTES_OF_A_LOCAL,
    BYTES_OF_AN_ENTRY,
    CARRYING,
    GROUP_WIDTH,
    MOST_HALO,
    MOST_TILES,
    PHASE,
    SUMMING,
    TILE,
    arrange_entries,
    make_batch_frame_kernel,
)
from physhandi.simulation.master_topology import MasterTopology
from physhandi.simulation.parameters import SimulationParameters

_NODE_COST = 12
"""Half-edges that take as long as what a node takes beside its springs (measured)."""
_LOCALS_STEP = 64
_SHARE_OF_LOCALS = 0.68
"""Part of a block's shared memory for nodes; the rest is for half-edges."""
batch_frame_kernel = lru_cache(maxsize=None)(make_batch_frame_kernel)


@dataclass(frozen=True, kw_only=True, eq=False)
class GroupBlocks:
    """Blocks of all groups, one after the other; a row is a place for a node in a tile."""

    group: Int[ndarray, " block"]
    """Group of each block."""
    own_count: Int[ndarray, " block"]
    """Nodes that each block moves."""
    border_count: Int[ndarray, " block"]
    """How many of them, the first ones, other blocks need."""
    local_start: Int[ndarray, " block_1"]
    """Start of each block's part of `local_node`."""
    local_node: Int[ndarray, " local"]
    """Nodes that a block needs: its own ones, then its halo."""
    tile_start: Int[ndarray, " block_1"]
    """First tile of each block."""
    tile_certain: Int[ndarray, " tile"]
    """Leading columns of each tile that all of its nodes and candidates have."""
    tile_end: Int[ndarray, " tile"]
    """Columns of each tile."""
    padding: Int[ndarray, " row"]
    """Half-edge that ties the node of each row to itself, for no candidate."""
    first: Int[ndarray, " bin"]
    """First half-edge by row, by whether a candidate may lack it, and by banks."""
    count: Int[ndarray, " bin"]
    """Number of these half-edges."""
    place: Int[ndarray, " half_edge"]
    """Bytes to the other end in shared memory, and from bit 16 on the candidates that lack it."""
    spring: Int[ndarray, " half_edge"]
    """Number of its spring."""

    @property
    def most_halo(self) -> int:
        """Most nodes that a block needs of others."""
        return int((np.diff(self.local_start) - self.own_count).max())

    @property
    def most_locals(self) -> int:
        """Most nodes that a block needs."""
        return int(np.diff(self.local_start).max())

    @property
    def most_tiles(self) -> int:
        """Most tiles of a block."""
        return int(np.diff(self.tile_start).max())

    @property
    def tile_first(self) -> Int[ndarray, " tile_1"]:
        """First place of each tile's half-edges once they are arranged."""
        return TILE * np.concatenate([[0], np.cumsum(self.tile_end)])

    @property
    def most_entries(self) -> int:
        """Most half-edges of a block, padding included."""
        return int(np.diff(self.tile_first[self.tile_start]).max())

    @classmethod
    def of(
        cls,
        node: Float32[ndarray, "node 3"],
        spring_nodes: Int[ndarray, "spring 2"],
        exists: Bool[ndarray, "group candidate spring"],
        block_count: int,
    ) -> "GroupBlocks":
        """Cut each group into blocks that take equally long.

        Args:
            node: Positions [m].
            spring_nodes: The two nodes of each spring.
            exists: Whether each candidate of a group has a spring.
            block_count: Blocks of all groups, at least one for each and no more than nodes.
        """
        work = [2 * part.any(axis=0).sum() + _NODE_COST * len(node) for part in exists]
        parts = [
            _cut_group(node, spring_nodes, part, blocks)
            for part, blocks in zip(exists, share_blocks(work, block_count), strict=True)
        ]
        joined = {
            name: np.concatenate([part[name] for part in parts])
            for name in parts[0]
            if not name.endswith("_start")
        }
        for name in ("local_start", "tile_start"):
            sizes = np.concatenate([np.diff(part[name]) for part in parts])
            joined[name] = np.concatenate([[0], np.cumsum(sizes)])
        group = np.repeat(np.arange(len(parts)), [len(part["own_count"]) for part in parts])
        first = np.cumsum(joined["count"]) - joined["count"]
        return cls(group=group, first=first, **joined)


def share_blocks(work: list[int], total: int) -> Int[ndarray, " group"]:
    """Share blocks among groups in proportion to their work; each gets one.

    Args:
        work: Of each group.
        total: Blocks, at least as many as groups.
    """
    weight = np.asarray(work, dtype=np.float64)
    shares = np.maximum(1, np.floor(weight / weight.sum() * total)).astype(np.int64)
    while shares.sum() > total:
        shares[np.argmin(np.where(shares > 1, weight / shares, np.inf))] -= 1
    while shares.sum() < total:
        shares[np.argmax(weight / shares)] += 1
    return shares


def _cut_group(
    node: Float32[ndarray, "node 3"],
    spring_nodes: Int[ndarray, "spring 2"],
    exists: Bool[ndarray, "candidate spring"],
    blocks: int,
) -> dict[str, ndarray]:
    """Cut one group; the arrays are those of `GroupBlocks`, as if it were the only one."""
    count = len(node)
    spring = np.flatnonzero(exists.any(axis=0))
    one, another = spring_nodes[spring].astype(np.int64).T
    source, other = np.concatenate([one, another]), np.concatenate([another, one])
    lacking = np.zeros(len(spring), dtype=np.int64)
    for candidate, has_spring in enumerate(exists):
        lacking |= ~has_spring[spring] * np.int64(1 << candidate)
    spring, lacking = np.tile(spring, 2), np.tile(lacking, 2)
    certain = lacking == 0
    degree = np.bincount(source, minlength=count)
    certain_degree = np.bincount(source[certain], minlength=count)
    order, own_start = bisect_nodes(node, blocks, (degree + _NODE_COST).astype(np.float64))
    own_count = np.diff(own_start)
    block = np.empty(count, dtype=np.int64)
    block[order] = np.repeat(np.arange(blocks), own_count)
    crosses = block[source] != block[other]
    is_inner = np.ones(count, dtype=bool)
    is_inner[other[crosses]] = False
    # Nodes of a tile wait for the one with the most half-edges, so similar ones come together.
    order = np.lexsort((-degree, -certain_degree, is_inner, block))
    local = np.empty(count, dtype=np.int64)
    local[order] = np.arange(count) - own_start[block[order]]

    beyond, needed = block[source[crosses]], other[crosses]
    is_halo = np.zeros((blocks, count), dtype=bool)
    is_halo[beyond, needed] = True
    halo_node = np.nonzero(is_halo)[1]
    halo_count = is_halo.sum(axis=1)
    halo_start = np.concatenate([[0], np.cumsum(halo_count)])
    halo_local = own_count[:, None] + np.cumsum(is_halo, axis=1) - 1
    other_local = local[other]
    other_local[crosses] = halo_local[beyond, needed]
    parts = zip(
        np.split(order, own_start[1:-1]), np.split(halo_node, halo_start[1:-1]), strict=True
    )

    tile_start = np.concatenate([[0], np.cumsum(-(-own_count // TILE))])
    rows = TILE * tile_start[-1]
    row = TILE * tile_start[block] + local
    row_degree, row_certain = np.zeros((2, rows), dtype=np.int64)
    row_degree[row], row_certain[row] = degree, certain_degree
    row_block = np.repeat(np.arange(blocks), TILE * np.diff(tile_start))
    row_local = np.minimum(np.arange(rows) - TILE * tile_start[row_block], own_count[row_block] - 1)
    bin_of = (2 * row[source] + ~certain) * PHASE + other_local % PHASE
    # Sorting numbers that are followed by their places takes a quarter of sorting places.
    by_bin = np.sort(bin_of * len(bin_of) + np.arange(len(bin_of))) % len(bin_of)
    return {
        "own_count": own_count,
        "border_count": np.bincount(block[~is_inner], minlength=blocks),
        "local_start": np.concatenate([[0], np.cumsum(own_count + halo_count)]),
        "local_node": np.concatenate([part for both in parts for part in both]),
        "tile_start": tile_start,
        "tile_certain": row_certain.reshape(-1, TILE).min(axis=1),
        "tile_end": row_degree.reshape(-1, TILE).max(axis=1),
        "padding": 4 * GROUP_WIDTH * row_local + (((1 << GROUP_WIDTH) - 1) << 16),
        "count": np.bincount(bin_of, minlength=2 * PHASE * rows),
        "place": (4 * GROUP_WIDTH * other_local + (lacking << 16))[by_bin],
        "spring": spring[by_bin],
    }


class BatchBlocks:
    """The blocks of a population on a CUDA device; one launch advances all by a frame."""

    def __init__(self, blocks: GroupBlocks, rest_length: ndarray, nodes: int, device: Any) -> None:
        """Copy blocks to the device; see `of`."""
        self._device, self._nodes = device, nodes
        self._groups = int(blocks.group[-1]) + 1
        self._blocks = len(blocks.group)
        entry = np.stack(
            [
                blocks.place.astype(np.int32),
                (1.0 / rest_length[blocks.spring]).astype(np.float32).view(np.int32),
            ],
            axis=1,
        )
        first = self._array(blocks.tile_first)
        end = self._array(blocks.tile_end)
        arranged = wp.zeros(int(blocks.tile_first[-1]), dtype=wp.vec2i, device=device)
        wp.launch(
            arrange_entries,
            dim=len(blocks.padding) // PHASE,
            inputs=[
                wp.array(entry, dtype=wp.vec2i, device=device),
                self._array(blocks.first),
                first,
                end,
                self._array(blocks.padding),
            ],
            outputs=[self._array(blocks.count), arranged],
            device=device,
        )
        names = ("group", "own_count", "border_count", "local_start", "local_node", "tile_start")
        self._table = [self._array(getattr(blocks, name)) for name in names]
        self._table += [first, self._array(blocks.tile_certain), end, arranged]
        self._relay = Relay(4 * GROUP_WIDTH * self._groups * nodes, device)

    @classmethod
    def of(
        cls,
        master: MasterTopology,
        lanes: Sequence[SimulationParameters],
        node_number: Int[ndarray, " node"],
        device: Any,
    ) -> "BatchBlocks | None":
        """Create one; None if there are too many groups, or a block would not fit the device.

        Args:
            master: Springs of all candidates.
            lanes: The candidates of the groups, one after the other.
            node_number: Index in the states of each of the model's nodes.
            device: Warp device.
        """
        nodes, groups = len(node_number), len(lanes) // GROUP_WIDTH
        total = min(int(device.sm_count), groups * (nodes // LEAST_OWN))
        locals_, entries = _room(device)
        if total < groups or nodes * groups > locals_ * total:
            return None
        springs = slice(None, master.object_spring_count)
        exists = np.stack([master.has(each)[springs] for each in lanes])
        node = np.empty_like(master.object_node)
        node[node_number] = master.object_node
        spring_nodes = node_number[master.spring_nodes[springs]]
        blocks = GroupBlocks.of(node, spring_nodes, exists.reshape(groups, GROUP_WIDTH, -1), total)
        fits = (
            blocks.most_halo <= MOST_HALO
            and blocks.most_tiles <= MOST_TILES
            and blocks.most_locals <= locals_
            and blocks.most_entries <= entries
        )
        rest_length = master.rest_length(lanes[0])
        return cls(blocks, rest_length, nodes, device) if fits else None

    def advance(
        self,
        substeps: int,
        before: wp.array,
        after: wp.array,
        *,
        model: list[wp.array],
        held: list[wp.array],
        controls: list[wp.array],
        diverged: wp.array,
    ) -> None:
        """Launch one frame.

        Args:
            substeps: Of the frame.
            before: State at its start.
            after: Where the state at its end goes; another array.
            model: Clearance, the candidates' numbers and how far each group's springs reach.
            held: Virtual springs by node: where they begin, what they are, their ranks.
            controls: Positions of the control nodes at its start and at its end [m].
            diverged: Where a candidate is marked that diverged.
        """
        tag = self._relay.next_tags(substeps + 1)
        inputs = [substeps, tag, self._nodes, self._groups, *model, *self._table, *held]
        wp.launch(
            batch_frame_kernel(*_room(self._device)),
            dim=self._blocks * (SUMMING + CARRYING),
            inputs=[*inputs, *controls, before],
            outputs=[self._relay.value, after, diverged],
            block_dim=SUMMING + CARRYING,
            device=self._device,
        )

    def _array(self, value: Int[ndarray, " n"]) -> wp.array:
        return wp.array(value.astype(np.int32), dtype=wp.int32, device=self._device)


def _room(device: Any) -> tuple[int, int]:
    """Return for how many nodes and half-edges a block has room."""
    taken = BYTES_OF_A_BLOCK + BYTES_OF_A_THREAD * (SUMMING + CARRYING)
    free = int(device.max_shared_memory_per_block) - taken
    locals_ = int(_SHARE_OF_LOCALS * free) // (BYTES_OF_A_LOCAL * _LOCALS_STEP) * _LOCALS_STEP
    return locals_, (free - BYTES_OF_A_LOCAL * locals_) // BYTES_OF_AN_ENTRY
