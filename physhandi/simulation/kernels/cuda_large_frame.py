"""The frame kernel for blocks that need more than static shared memory.

It moves nodes as `cuda_frame` does; two things differ. Nodes lie in dynamic shared memory, and
half-edges are packed in the order in which threads read them: the same column of neighbouring
threads lies side by side, 16 bytes each, and the first columns stay in registers.
"""

import warp as wp

from physhandi.simulation.kernels.contacts import advance
from physhandi.simulation.kernels.cuda_frame import control_position, control_velocity, pull
from physhandi.simulation.kernels.integration import free_velocity, is_too_fast
from physhandi.simulation.kernels.intrinsics import (
    bits_to_float,
    block_barrier,
    float_to_bits,
    lane_sum,
    large_read,
    large_write,
    publish,
    read_four,
    wait_for_both,
)
from physhandi.simulation.kernels.world import World

FLOATS_OF_A_LOCAL = 16
"""Shared memory of a node: position and velocity, twice, in four floats each."""


@wp.kernel(enable_backward=False)
def pack_half_edges(
    world: wp.array[World],
    place: wp.array[int],
    spring: wp.array[int],
    rest_length: wp.array[float],
    stiffness: wp.array[float],
    damping: wp.array[float],
    packed_out: wp.array[wp.vec4],
):
    """Write a half-edge's other end, rest length, stiffness [N/m] and damping side by side.

    Padding (spring -1) ties a node to itself by a spring without force.
    """
    slot = wp.tid()
    other = bits_to_float(place[slot])
    s = spring[slot]
    if s < 0:
        packed_out[slot] = wp.vec4(other, 0.0, 0.0, 0.0)
    else:
        r = rest_length[s]
        hooke = world[0].stiffness_scale * stiffness[s] / r
        packed_out[slot] = wp.vec4(other, r, hooke, damping[s])


def make_large_frame_kernel(lanes: int, in_registers: int, threads: int, locals_: int) -> wp.Kernel:
    """Make the kernel that advances one frame.

    Args:
        lanes: Threads that sum one node's springs: 1, 2, 4 or 8.
        in_registers: Half-edges that each thread keeps in registers; more are read every substep.
        threads: Of a block.
        locals_: Nodes, its own and its halo, that a block has room for.
    """
    kept_float = wp.types.vector(length=in_registers, dtype=wp.float32)
    kept_int = wp.types.vector(length=in_registers, dtype=wp.int32)
    room = FLOATS_OF_A_LOCAL * locals_

    @wp.kernel(enable_backward=False, module="unique", launch_bounds=threads)
    def advance_large_frame(
        chunks: int,
        substeps: int,
        tag: int,
        # Model:
        world: wp.array[World],
        body_of: wp.array[int],
        clearance: wp.array[float],
        own_start: wp.array[int],
        local_start: wp.array[int],
        local_node: wp.array[int],
        model_node: wp.array[int],
        slot_start: wp.array[int],
        packed: wp.array[wp.vec4],
        # State in:
        control_start: wp.array[wp.vec3],
        control_end: wp.array[wp.vec3],
        position: wp.array[wp.vec3],
        velocity: wp.array[wp.vec3],
        # State out:
        relay_out: wp.array[wp.vec4],
        position_out: wp.array[wp.vec3],
        velocity_out: wp.array[wp.vec3],
        first_divergence_out: wp.array[int],
    ):
        """Advance each block's nodes through all substeps of a frame."""
        # The only tile: Warp launches with as much dynamic shared memory as it needs.
        tile = wp.tile_empty(shape=wp.static(room), dtype=wp.float32, storage="shared")  # noqa: F841

        thread = wp.tid()
        block = thread // wp.static(threads)
        place = thread - block * wp.static(threads)
        lane = place % wp.static(lanes)
        row = place // wp.static(lanes)
        warp_lane = place % 32
        body = body_of[block]
        control_rate = world[body].control_rate
        count = model_node.shape[0]
        first = own_start[block]
        own = own_start[block + 1] - first
        locals_first = local_start[block]
        halo = local_start[block + 1] - locals_first - own

        # A warp's columns are 32 half-edges wide; those of its first nodes are kept.
        group = block * chunks * wp.static(threads // 32) + place // 32
        index = kept_int()
        rest = kept_float()
        hooke = kept_float()
        dashpot = kept_float()
        kept_first = slot_start[group]
        kept_last = slot_start[group + 1]
        for k in range(wp.static(in_registers)):
            index[k] = wp.min(row, own - 1)
            if kept_first + 32 * k < kept_last:
                half_edge = read_four(packed, kept_first + 32 * k + warp_lane)
                index[k] = float_to_bits(half_edge[0])
                rest[k] = half_edge[1]
                hooke[k] = half_edge[2]
                dashpot[k] = half_edge[3]

        for i in range(place, own, wp.static(threads)):
            node = first + i
            x = position[model_node[node]]
            v = velocity[model_node[node]]
            large_write(i, x)
            large_write(wp.static(locals_) + i, v)
            publish(relay_out, 2 * node, x, tag)
            publish(relay_out, 2 * node + 1, v, tag)

        for substep in range(substeps):
            parity = substep % 2
            now = wp.static(2 * locals_) * parity
            later = wp.static(2 * locals_) - now
            fraction = float(substep + 1) / float(substeps)
            for m in range(place, halo, wp.static(threads)):
                local = own + m
                node = local_node[locals_first + local]
                x = wp.vec3(0.0, 0.0, 0.0)
                v = wp.vec3(0.0, 0.0, 0.0)
                if node < count:
                    both = wait_for_both(relay_out, 2 * (parity * count + node), tag + substep)
                    x = wp.vec3(both[0], both[1], both[2])
                    v = wp.vec3(both[3], both[4], both[5])
                else:
                    x = control_position(node - count, fraction, control_start, control_end)
                    v = control_velocity(node - count, control_rate, control_start, control_end)
                large_write(now + local, x)
                large_write(now + wp.static(locals_) + local, v)
            block_barrier()
            for chunk in range(chunks):
                i = chunk * wp.static(threads // lanes) + row
                n = wp.min(i, own - 1)
                x = large_read(now + n)
                v = large_read(now + wp.static(locals_) + n)
                force = wp.vec3(0.0, 0.0, 0.0)
                columns = group + chunk * wp.static(threads // 32)
                begin = slot_start[columns]
                end = slot_start[columns + 1]
                if chunk == 0:
                    begin = begin + wp.static(32 * in_registers)
                    for k in range(wp.static(in_registers)):
                        offset = large_read(now + index[k]) - x
                        stretch = large_read(now + wp.static(locals_) + index[k]) - v
                        force += pull(offset, stretch, rest[k], hooke[k], dashpot[k])
                for slot in range(begin + warp_lane, end, 32):
                    half_edge = read_four(packed, slot)
                    other = float_to_bits(half_edge[0])
                    offset = large_read(now + other) - x
                    stretch = large_read(now + wp.static(locals_) + other) - v
                    force += pull(offset, stretch, half_edge[1], half_edge[2], half_edge[3])
                force = lane_sum(force, wp.static(lanes))
                if lane == 0 and i < own:
                    # Read late: its registers are better used for springs until here.
                    here = world[body]
                    node = first + i
                    touching = clearance[model_node[node]]
                    motion = advance(here, touching, x, free_velocity(here, v, force))
                    relay = 2 * ((1 - parity) * count + node)
                    publish(relay_out, relay, motion.position, tag + substep + 1)
                    publish(relay_out, relay + 1, motion.velocity, tag + substep + 1)
                    large_write(later + i, motion.position)
                    large_write(later + wp.static(locals_) + i, motion.velocity)
                    if is_too_fast(here, motion.velocity):
                        wp.atomic_min(
                            first_divergence_out, body, substep * count + model_node[node]
                        )
                    if substep == substeps - 1:
                        position_out[model_node[node]] = motion.position
                        velocity_out[model_node[node]] = motion.velocity

    return advance_large_frame
