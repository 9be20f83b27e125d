"""Half-edges in the order in which the threads of a block read them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int32
from numpy import ndarray

from physhandi.simulation.partition import Partition

WARP = 32
"""Threads that read side by side."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Columns:
    """Columns of 32 half-edges, one for each thread of a warp, group by group.

    A block's nodes take turns if it has more than rows of threads: each turn is a chunk. A group
    is what one warp does in one chunk; its columns are as many as its thread with the most needs.
    """

    chunk_count: int
    """Turns that each block takes."""
    start: Int32[ndarray, " group_1"]
    """Where each group's half-edges begin: block by block, chunk by chunk, warp by warp."""
    place: Int32[ndarray, " slot"]
    """Place of the other end in the block's part of `local_node`; padding ends where it begins."""
    spring: Int32[ndarray, " slot"]
    """Which spring it is; -1 for padding."""


def arrange_columns(partition: Partition, lanes: int, threads: int) -> Columns:
    """Share out half-edges to threads.

    Args:
        partition: Blocks and their nodes' half-edges.
        lanes: Threads that sum one node's springs; divides 32.
        threads: Threads of a block; a multiple of 32.
    """
    rows, warps = threads // lanes, threads // WARP
    own_count = np.diff(partition.own_start)
    chunks = -(-partition.most_own // rows)
    block = np.repeat(np.arange(partition.block_count), own_count)
    chunk, row = np.divmod(np.arange(len(block)) - partition.own_start[block], rows)
    group = (block * chunks + chunk) * warps + row * lanes // WARP
    degree = np.diff(partition.entry_start)
    count = np.zeros(partition.block_count * chunks * warps, dtype=np.int64)
    np.maximum.at(count, group, -(-degree // lanes))
    start = WARP * np.concatenate([[0], np.cumsum(count)])

    turn, warp = np.divmod(np.repeat(np.arange(len(count)), WARP * count), warps)
    thread = WARP * warp + np.arange(len(turn)) % WARP
    place = np.minimum(turn % chunks * rows + thread // lanes, own_count[turn // chunks] - 1)
    spring = np.full(len(place), -1)
    node = np.repeat(np.arange(len(block)), degree)
    column, lane = np.divmod(np.arange(len(node)) - partition.entry_start[node], lanes)
    slot = start[group[node]] + WARP * column + (row[node] * lanes + lane) % WARP
    place[slot], spring[slot] = partition.entry.T
    return Columns(
        chunk_count=chunks,
        start=start.astype(np.int32),
        place=place.astype(np.int32),
        spring=spring.astype(np.int32),
    )
