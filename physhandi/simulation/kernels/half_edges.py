"""The springs at a node, as the threads of a CUDA block read them or keep them in registers.

Each spring is there twice, once for each end: a half-edge. The lanes of a row, which are
neighbouring threads, share the half-edges of one node.
"""

import warp as wp

WARP = 32
"""Threads of a warp."""


@wp.kernel(enable_backward=False)
def arrange_half_edges(
    chunks: int,
    warps: int,
    lanes: int,
    own_start: wp.array[int],
    entry_start: wp.array[int],
    entry: wp.array[wp.vec2i],
    start: wp.array[int],
    place_out: wp.array[int],
    spring_out: wp.array[int],
):
    """Copy the half-edges of each thread to its places in the columns of its group.

    Args:
        chunks: Chunks of each block, of as many nodes as it has rows of threads.
        warps: Warps of each block.
        lanes: Threads that sum one node's springs.
        own_start: First own node of each block.
        entry_start: First half-edge of each node.
        entry: Half-edges: place of the other end, and spring.
        start: Start of each group's columns; a group is a warp of a chunk of a block.
        place_out: Places of the other ends; padding ends where it begins.
        spring_out: Springs; -1 for padding.
    """
    group, lane = wp.tid()
    turn = group // warps
    thread = WARP * (group % warps) + lane
    block = turn // chunks
    first = own_start[block]
    own = own_start[block + 1] - first
    row = (turn % chunks) * (WARP * warps // lanes) + thread // lanes
    begin = int(0)
    end = int(0)
    if row < own:
        begin = entry_start[first + row] + thread % lanes
        end = entry_start[first + row + 1]
    for slot in range(start[group] + lane, start[group + 1], WARP):
        place_out[slot] = wp.min(row, own - 1)
        spring_out[slot] = -1
        if begin < end:
            place_out[slot] = entry[begin][0]
            spring_out[slot] = entry[begin][1]
        begin += lanes


@wp.func
def entries_of(row: int, own: int, first: int, entry_start: wp.array[int]):
    """Return where the half-edges of a row's node begin and end; rows without a node have none."""
    begin = int(0)
    end = int(0)
    if row < own:
        begin = entry_start[first + row]
        end = entry_start[first + row + 1]
    return begin, end


def make_loader(lanes: int, in_registers: int) -> wp.Function:
    """Make the function that loads a thread's half-edges.

    Args:
        lanes: Threads that sum one node's springs.
        in_registers: Half-edges that each thread keeps.
    """
    kept_float = wp.types.vector(length=in_registers, dtype=wp.float32)
    kept_int = wp.types.vector(length=in_registers, dtype=wp.int32)

    @wp.func
    def load_half_edges(
        entry_first: int,
        entry_last: int,
        lane: int,
        stiffness_scale: float,
        entry: wp.array[wp.vec2i],
        rest_length: wp.array[float],
        stiffness: wp.array[float],
        damping: wp.array[float],
    ):
        """Return other end, -1 if there is none, spring, rest length, stiffness, damping."""
        other = kept_int()
        spring = kept_int()
        rest = kept_float()
        hooke = kept_float()
        dashpot = kept_float()
        for k in range(wp.static(in_registers)):
            e = entry_first + lane + wp.static(lanes) * k
            other[k] = -1
            if e < entry_last:
                s = entry[e][1]
                other[k] = entry[e][0]
                spring[k] = s
                rest[k] = rest_length[s]
                hooke[k] = stiffness_scale * stiffness[s] / rest_length[s]
                dashpot[k] = damping[s]
        return other, spring, rest, hooke, dashpot

    return load_half_edges
