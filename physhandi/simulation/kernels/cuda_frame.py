"""One launch for many substeps on CUDA: blocks wait for each other's nodes, not at barriers.

Each block owns a compact group of nodes and keeps their half-edges in registers. In a substep
it waits for the nodes beyond its border (the halo), sums the springs of its own nodes with
several threads a node, moves them, and publishes them under the next substep's tag. A block
can run ahead of a neighbour by one substep at most, because it needs the neighbour's values;
so two places a node suffice.
"""

import warp as wp

from physhandi.simulation.kernels.contacts import advance
from physhandi.simulation.kernels.half_edges import entries_of, make_loader
from physhandi.simulation.kernels.integration import free_velocity, is_too_fast
from physhandi.simulation.kernels.intrinsics import (
    SHARED_SLOTS,
    block_barrier,
    inverse_length,
    lane_sum,
    publish,
    refined_length,
    shared_read,
    shared_write,
    wait_for,
)
from physhandi.simulation.kernels.world import World

FORWARD_LOCALS = SHARED_SLOTS // 4
"""Most nodes, its own and its halo, that a block can hold; four slots of shared memory each."""


@wp.func
def pull(
    offset: wp.vec3,
    stretch: wp.vec3,
    rest_length: float,
    stiffness: float,
    damping: float,
):
    """Return a spring's force on the end that `offset` starts from; stiffness is in N/m."""
    squared = wp.dot(offset, offset)
    inverse = inverse_length(squared)
    length = refined_length(squared, inverse)
    rate = inverse * wp.dot(stretch, offset)
    tension = stiffness * (length - rest_length) + damping * rate
    return (tension * inverse) * offset


@wp.func
def control_position(
    control: int,
    fraction: float,
    control_start: wp.array[wp.vec3],
    control_end: wp.array[wp.vec3],
):
    """Return where a control node is, a fraction of the frame after its start."""
    start = control_start[control]
    return start + fraction * (control_end[control] - start)


@wp.func
def control_velocity(
    control: int,
    rate: float,
    control_start: wp.array[wp.vec3],
    control_end: wp.array[wp.vec3],
):
    """Return how fast springs see a control node move."""
    return rate * (control_end[control] - control_start[control])


def make_frame_kernel(lanes: int, in_registers: int) -> wp.Kernel:
    """Make the kernel that advances one frame.

    Args:
        lanes: Threads that sum one node's springs: 8, 16 or 32.
        in_registers: Half-edges that each thread keeps in registers; more are read every substep.
    """
    load_half_edges = make_loader(lanes, in_registers)

    @wp.kernel(enable_backward=False, module="unique", launch_bounds=1024)
    def advance_frame(
        threads: int,
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
        entry_start: wp.array[int],
        entry: wp.array[wp.vec2i],
        rest_length: wp.array[float],
        stiffness: wp.array[float],
        damping: wp.array[float],
        # State in:
        control_start: wp.array[wp.vec3],
        control_end: wp.array[wp.vec3],
        position: wp.array[wp.vec3],
        velocity: wp.array[wp.vec3],
        # State out:
        relay_out: wp.array[wp.vec4],
        tape_out: wp.array2d[wp.vec4],
        position_out: wp.array[wp.vec3],
        velocity_out: wp.array[wp.vec3],
        first_divergence_out: wp.array[int],
    ):
        """Advance each block's nodes through all substeps of a frame."""
        thread = wp.tid()
        block = thread // threads
        place = thread - block * threads
        lane = place % wp.static(lanes)
        row = place // wp.static(lanes)
        rows = threads // wp.static(lanes)
        body = body_of[block]
        here = world[body]
        count = model_node.shape[0]
        first = own_start[block]
        own = own_start[block + 1] - first
        locals_first = local_start[block]
        halo = local_start[block + 1] - locals_first - own

        first_clearance = clearance[model_node[first + wp.min(row, own - 1)]]
        entry_first, entry_last = entries_of(row, own, first, entry_start)
        index, _, rest, hooke, dashpot = load_half_edges(
            entry_first,
            entry_last,
            lane,
            here.stiffness_scale,
            entry,
            rest_length,
            stiffness,
            damping,
        )

        for i in range(place, own, threads):
            node = first + i
            x = position[model_node[node]]
            v = velocity[model_node[node]]
            shared_write(i, x)
            shared_write(wp.static(FORWARD_LOCALS) + i, v)
            publish(relay_out, 2 * node, x, tag)
            publish(relay_out, 2 * node + 1, v, tag)

        for substep in range(substeps):
            parity = substep % 2
            now = 2 * wp.static(FORWARD_LOCALS) * parity
            later = 2 * wp.static(FORWARD_LOCALS) - now
            fraction = float(substep + 1) / float(substeps)
            for m in range(place, 2 * halo, threads):
                part = int(0)
                if m >= halo:
                    part = 1
                local = own + m - part * halo
                node = local_node[locals_first + local]
                value = wp.vec3(0.0, 0.0, 0.0)
                if node < count:
                    value = wait_for(relay_out, 2 * (parity * count + node) + part, tag + substep)
                elif part == 0:
                    value = control_position(node - count, fraction, control_start, control_end)
                else:
                    value = control_velocity(
                        node - count, here.control_rate, control_start, control_end
                    )
                shared_write(now + part * wp.static(FORWARD_LOCALS) + local, value)
            block_barrier()
            for from_row in range(0, own, rows):
                i = from_row + row
                n = wp.min(i, own - 1)
                x = shared_read(now + n)
                v = shared_read(now + wp.static(FORWARD_LOCALS) + n)
                force = wp.vec3(0.0, 0.0, 0.0)
                begin = entry_first + wp.static(lanes * in_registers)
                end = entry_last
                if from_row == 0:
                    for k in range(wp.static(in_registers)):
                        if index[k] >= 0:
                            offset = shared_read(now + index[k]) - x
                            stretch = shared_read(now + wp.static(FORWARD_LOCALS) + index[k]) - v
                            force += pull(offset, stretch, rest[k], hooke[k], dashpot[k])
                else:
                    begin = entry_start[first + n]
                    end = entry_start[first + n + 1]
                if i < own:
                    for e in range(begin + lane, end, wp.static(lanes)):
                        other = entry[e][0]
                        spring = entry[e][1]
                        offset = shared_read(now + other) - x
                        stretch = shared_read(now + wp.static(FORWARD_LOCALS) + other) - v
                        r = rest_length[spring]
                        force += pull(
                            offset,
                            stretch,
                            r,
                            here.stiffness_scale * stiffness[spring] / r,
                            damping[spring],
                        )
                force = lane_sum(force, wp.static(lanes))
                if lane == 0 and i < own:
                    free = free_velocity(here, v, force)
                    node = first + i
                    touching = first_clearance
                    if from_row > 0:
                        touching = clearance[model_node[node]]
                    motion = advance(here, touching, x, free)
                    relay = 2 * ((1 - parity) * count + node)
                    publish(relay_out, relay, motion.position, tag + substep + 1)
                    publish(relay_out, relay + 1, motion.velocity, tag + substep + 1)
                    shared_write(later + i, motion.position)
                    shared_write(later + wp.static(FORWARD_LOCALS) + i, motion.velocity)
                    if tape_out.shape[0] > 0:
                        tape_out[substep, 3 * node] = wp.vec4(x[0], x[1], x[2], 0.0)
                        tape_out[substep, 3 * node + 1] = wp.vec4(v[0], v[1], v[2], 0.0)
                        tape_out[substep, 3 * node + 2] = wp.vec4(free[0], free[1], free[2], 0.0)
                    if is_too_fast(here, motion.velocity):
                        wp.atomic_min(
                            first_divergence_out, body, substep * count + model_node[node]
                        )
                    if substep == substeps - 1:
                        position_out[model_node[node]] = motion.position
                        velocity_out[model_node[node]] = motion.velocity

    return advance_frame
