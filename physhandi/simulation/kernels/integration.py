"""One substep of every node: sum the springs, add gravity and drag, move, touch the ground."""

import warp as wp

from physhandi.simulation.kernels.contacts import advance
from physhandi.simulation.kernels.world import World

wp.set_module_options({"enable_backward": False})


@wp.func
def spring_sum(
    node: int,
    entry_start: wp.array[int],
    entry: wp.array[int],
    value: wp.array[wp.vec3],
):
    """Sum a node's entries: value `s`, or minus value `s` where the entry is `-s - 1`."""
    total = wp.vec3(0.0, 0.0, 0.0)
    for place in range(entry_start[node], entry_start[node + 1]):
        index = entry[place]
        if index >= 0:
            total += value[index]
        else:
            total -= value[-index - 1]
    return total


@wp.func
def free_velocity(world: World, velocity: wp.vec3, force: wp.vec3):
    """Return a node's velocity after force, gravity and drag, before any contact."""
    acceleration = force - wp.vec3(0.0, 0.0, world.gravity)
    kick = world.dt * acceleration
    # One rounding only: next to 1, a decay factor in float32 changes the drag by 0.04 %.
    return velocity + (kick - world.velocity_loss * (velocity + kick))


@wp.func
def is_too_fast(world: World, velocity: wp.vec3):
    """Return whether a node has diverged; written so that NaN is caught too."""
    return not (wp.length_sq(velocity) <= world.speed_limit * world.speed_limit)


@wp.kernel
def sum_rows(
    # Model:
    row_start: wp.array[int],
    half_edge: wp.array[int],
    # State in:
    value: wp.array[wp.vec3],
    # State out:
    sum_out: wp.array[wp.vec3],
):
    """Sum a few springs of one node (one thread per row of half-edges)."""
    row = wp.tid()
    sum_out[row] = spring_sum(row, row_start, half_edge, value)


@wp.kernel
def integrate_nodes(
    substep: int,
    # Model:
    world: wp.array[World],
    clearance: wp.array[float],
    entry_start: wp.array[int],
    entry: wp.array[int],
    # State in:
    position: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
    pull: wp.array[wp.vec3],
    # State out:
    free_velocity_out: wp.array[wp.vec3],
    position_out: wp.array[wp.vec3],
    velocity_out: wp.array[wp.vec3],
    first_divergence_out: wp.array[int],
):
    """Advance each object node by a semi-implicit Euler substep (one thread per node).

    The outputs may be the inputs: no thread reads another node. `free_velocity_out` is the
    velocity before contact, which the adjoint needs; it may be empty.
    """
    node = wp.tid()
    force = spring_sum(node, entry_start, entry, pull)
    free = free_velocity(world[0], velocity[node], force)
    motion = advance(world[0], clearance[node], position[node], free)
    position_out[node] = motion.position
    velocity_out[node] = motion.velocity
    if free_velocity_out.shape[0] > 0:
        free_velocity_out[node] = free
    # An integer minimum does not depend on thread order.
    if is_too_fast(world[0], motion.velocity):
        wp.atomic_min(first_divergence_out, 0, substep * position.shape[0] + node)
