"""The adjoint of `cuda_frame`: one launch walks a frame's tape back, substep by substep.

A node's owner undoes contact, drag and integration, publishes the adjoint of the node's force,
and then sums what the springs say of its old state. A bar is the derivative of the loss.
"""

import warp as wp

from physhandi.simulation.kernels.adjoint import before_drag, node_adjoint
from physhandi.simulation.kernels.contacts import Motion
from physhandi.simulation.kernels.cuda_frame import control_position, control_velocity
from physhandi.simulation.kernels.half_edges import entries_of, make_loader
from physhandi.simulation.kernels.intrinsics import (
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

ADJOINT_LOCALS = 448
"""Most nodes, its own and its halo, that a block can hold; six slots of shared memory each."""


@wp.struct
class SpringAdjoint:
    """Adjoints of the offset, stretch, stiffness and damping of one spring."""

    offset: wp.vec3
    stretch: wp.vec3
    log_stiffness: wp.float32
    damping: wp.float32


@wp.func
def pull_adjoint(
    offset: wp.vec3,
    stretch: wp.vec3,
    pull_bar: wp.vec3,
    rest_length: float,
    stiffness: float,
    damping: float,
):
    """Carry the adjoint of a spring's force back; see `adjoint.springs_adjoint`.

    Args:
        offset: From this end to the other.
        stretch: Velocity of the other end less that of this end.
        pull_bar: Adjoint of the force on this end less that on the other.
        rest_length: In metres.
        stiffness: In N/m.
        damping: In N·s/m.
    """
    squared = wp.dot(offset, offset)
    inverse = inverse_length(squared)
    strain = refined_length(squared, inverse) - rest_length
    direction = inverse * offset
    rate = wp.dot(stretch, direction)
    closing = wp.dot(pull_bar, direction)
    tension = stiffness * strain + damping * rate
    dashpot = damping * closing
    bar = SpringAdjoint()
    bar.offset = (
        (stiffness * closing) * direction
        + (tension * inverse) * (pull_bar - closing * direction)
        + (dashpot * inverse) * (stretch - rate * direction)
    )
    bar.stretch = dashpot * direction
    bar.log_stiffness = closing * stiffness * strain
    bar.damping = closing * rate
    return bar


@wp.func
def xyz(value: wp.vec4):
    """Return the first three of four numbers."""
    return wp.vec3(value[0], value[1], value[2])


@wp.func
def tape_item(
    place: int, locals_count: int, locals_first: int, local_node: wp.array[int], count: int
):
    """Return which value of a substep's tape a thread stages first, or -1 if it stages none."""
    part = place // locals_count
    if part > 1:
        return -1
    node = local_node[locals_first + place - part * locals_count]
    if node >= count:
        return -1
    return 3 * node + part


def make_adjoint_kernel(lanes: int, in_registers: int) -> wp.Kernel:
    """Make the kernel that walks one frame back.

    Args:
        lanes: Threads that sum one node's springs: 8, 16 or 32.
        in_registers: Half-edges that each thread keeps in registers; there must be no more.
    """
    kept_float = wp.types.vector(length=in_registers, dtype=wp.float32)
    load_half_edges = make_loader(lanes, in_registers)

    @wp.kernel(enable_backward=False, module="unique", launch_bounds=768)
    def frame_adjoint(
        threads: int,
        substeps: int,
        tag: int,
        # Model:
        world: wp.array[World],
        clearance: wp.array[float],
        own_start: wp.array[int],
        local_start: wp.array[int],
        local_node: wp.array[int],
        model_node: wp.array[int],
        entry_start: wp.array[int],
        entry: wp.array[wp.vec2i],
        is_first: wp.array[int],
        object_spring_count: int,
        rest_length: wp.array[float],
        stiffness: wp.array[float],
        damping: wp.array[float],
        # State in:
        control_start: wp.array[wp.vec3],
        control_end: wp.array[wp.vec3],
        tape: wp.array2d[wp.vec4],
        # Adjoint, changed in place:
        position_bar_out: wp.array[wp.vec3],
        velocity_bar_out: wp.array[wp.vec3],
        # Adjoint out:
        relay_out: wp.array[wp.vec4],
        log_stiffness_bar_out: wp.array[float],
        damping_bar_out: wp.array[float],
        drag_bar_out: wp.array[float],
        restitution_bar_out: wp.array[float],
        friction_bar_out: wp.array[float],
        start_bar_out: wp.array[wp.vec3],
        end_bar_out: wp.array[wp.vec3],
    ):
        """Carry each block's adjoints from the end of a frame to its start."""
        thread = wp.tid()
        block = thread // threads
        place = thread - block * threads
        lane = place % wp.static(lanes)
        row = place // wp.static(lanes)
        here = world[0]
        count = model_node.shape[0]
        first = own_start[block]
        own = own_start[block + 1] - first
        locals_first = local_start[block]
        locals_count = local_start[block + 1] - locals_first
        halo = locals_count - own

        entry_first, entry_last = entries_of(row, own, first, entry_start)
        index, spring, rest, hooke, dashpot = load_half_edges(
            entry_first,
            entry_last,
            lane,
            here.stiffness_scale,
            entry,
            rest_length,
            stiffness,
            damping,
        )
        log_stiffness_bar = kept_float()
        damping_bar = kept_float()

        # The row's first lane carries its node's adjoints from substep to substep.
        own_node = wp.min(first + row, first + own - 1)
        is_owner = lane == 0 and row < own
        touching = clearance[model_node[own_node]]
        after = Motion()
        if is_owner:
            after.position = position_bar_out[model_node[own_node]]
            after.velocity = velocity_bar_out[model_node[own_node]]
        drag_bar = float(0.0)
        restitution_bar = float(0.0)
        friction_bar = float(0.0)

        # The tape comes from far away: what a thread needs of it is read one substep ahead.
        own_position = tape[substeps - 1, 3 * own_node]
        own_free = tape[substeps - 1, 3 * own_node + 2]
        item = tape_item(place, locals_count, locals_first, local_node, count)
        ahead = wp.vec4(0.0, 0.0, 0.0, 0.0)
        if item >= 0:
            ahead = tape[substeps - 1, item]

        for step in range(substeps):
            substep = substeps - 1 - step
            parity = step % 2
            now = 3 * wp.static(ADJOINT_LOCALS) * parity
            fraction = float(substep + 1) / float(substeps)
            if is_owner:
                free = xyz(own_free)
                before = node_adjoint(here, touching, xyz(own_position), free, after)
                free_bar = before.motion.velocity
                after.position = before.motion.position
                after.velocity = before_drag(here, free_bar)
                force_bar = here.dt * after.velocity
                publish(relay_out, parity * count + own_node, force_bar, tag + step)
                shared_write(now + 2 * wp.static(ADJOINT_LOCALS) + row, force_bar)
                drag_bar -= here.dt * wp.dot(free, free_bar)
                restitution_bar += before.restitution
                friction_bar += before.friction
            for m in range(place, 2 * locals_count, threads):
                part = int(0)
                if m >= locals_count:
                    part = 1
                local = m - part * locals_count
                node = local_node[locals_first + local]
                value = wp.vec3(0.0, 0.0, 0.0)
                if m == place and item >= 0:
                    value = xyz(ahead)
                elif node < count:
                    value = xyz(tape[substep, 3 * node + part])
                elif part == 0:
                    value = control_position(node - count, fraction, control_start, control_end)
                else:
                    value = control_velocity(
                        node - count, here.control_rate, control_start, control_end
                    )
                shared_write(now + part * wp.static(ADJOINT_LOCALS) + local, value)
            for m in range(place, halo, threads):
                node = local_node[locals_first + own + m]
                value = wp.vec3(0.0, 0.0, 0.0)
                if node < count:
                    value = wait_for(relay_out, parity * count + node, tag + step)
                shared_write(now + 2 * wp.static(ADJOINT_LOCALS) + own + m, value)
            block_barrier()

            if substep > 0:
                own_position = tape[substep - 1, 3 * own_node]
                own_free = tape[substep - 1, 3 * own_node + 2]
                if item >= 0:
                    ahead = tape[substep - 1, item]
            n = wp.min(row, own - 1)
            x = shared_read(now + n)
            v = shared_read(now + wp.static(ADJOINT_LOCALS) + n)
            force_bar = shared_read(now + 2 * wp.static(ADJOINT_LOCALS) + n)
            place_bar = wp.vec3(0.0, 0.0, 0.0)
            speed_bar = wp.vec3(0.0, 0.0, 0.0)
            for k in range(wp.static(in_registers)):
                if index[k] >= 0:
                    offset = shared_read(now + index[k]) - x
                    stretch = shared_read(now + wp.static(ADJOINT_LOCALS) + index[k]) - v
                    other_bar = shared_read(now + 2 * wp.static(ADJOINT_LOCALS) + index[k])
                    bar = pull_adjoint(
                        offset, stretch, force_bar - other_bar, rest[k], hooke[k], dashpot[k]
                    )
                    place_bar -= bar.offset
                    speed_bar -= bar.stretch
                    log_stiffness_bar[k] += bar.log_stiffness
                    damping_bar[k] += bar.damping
                    held = spring[k] - object_spring_count
                    if held >= 0:
                        # No other thread adds to this spring, so the sum has one order.
                        by_rate = here.control_rate * bar.stretch
                        at_start = (1.0 - fraction) * bar.offset - by_rate
                        wp.atomic_add(start_bar_out, held, at_start)
                        wp.atomic_add(end_bar_out, held, fraction * bar.offset + by_rate)
            place_bar = lane_sum(place_bar, wp.static(lanes))
            speed_bar = lane_sum(speed_bar, wp.static(lanes))
            if is_owner:
                after.position += place_bar
                after.velocity += speed_bar

        if is_owner:
            node = model_node[own_node]
            position_bar_out[node] = after.position
            velocity_bar_out[node] = after.velocity
            drag_bar_out[node] = drag_bar
            restitution_bar_out[node] = restitution_bar
            friction_bar_out[node] = friction_bar
        for k in range(wp.static(in_registers)):
            e = entry_first + lane + wp.static(lanes) * k
            if index[k] >= 0 and is_first[e] == 1:
                log_stiffness_bar_out[spring[k]] = log_stiffness_bar[k]
                damping_bar_out[spring[k]] = damping_bar[k]

    return frame_adjoint


@wp.kernel
def sum_controls(
    # Model:
    spring_start: wp.array[int],
    spring: wp.array[int],
    # Adjoint in:
    start_bar: wp.array[wp.vec3],
    end_bar: wp.array[wp.vec3],
    # Adjoint out:
    control_start_bar_out: wp.array[wp.vec3],
    control_end_bar_out: wp.array[wp.vec3],
):
    """Sum over the virtual springs of each control node (one thread a control node)."""
    control = wp.tid()
    start = wp.vec3(0.0, 0.0, 0.0)
    end = wp.vec3(0.0, 0.0, 0.0)
    for place in range(spring_start[control], spring_start[control + 1]):
        start += start_bar[spring[place]]
        end += end_bar[spring[place]]
    control_start_bar_out[control] = start
    control_end_bar_out[control] = end
