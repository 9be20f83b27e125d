"""One substep of every node: sum the springs, add gravity and drag, move, touch the ground."""

import warp as wp

from physhandi.simulation.kernels.contacts import advance
from physhandi.simulation.kernels.world import World

wp.set_module_options({"enable_backward": False})


@wp.func
def spring_sum(
    node: int,
    half_edge_start: wp.array[int],
    half_edge: wp.array[int],
    value: wp.array[wp.vec3],
):
    """Sum what the springs of a node say, with the sign of the end that it is at."""
    total = wp.vec3(0.0, 0.0, 0.0)
    for entry in range(half_edge_start[node], half_edge_start[node + 1]):
        spring = half_edge[entry]
        if spring >= 0:
            total += value[spring]
        else:
            total -= value[-spring - 1]
    return total


@wp.kernel
def integrate_nodes(
    substep: int,
    # Model:
    world: wp.array[World],
    half_edge_start: wp.array[int],
    half_edge: wp.array[int],
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
    force = spring_sum(node, half_edge_start, half_edge, pull)
    acceleration = force - wp.vec3(0.0, 0.0, world[0].gravity)
    kick = world[0].dt * acceleration
    # One rounding only: next to 1, a decay factor in float32 changes the drag by 0.04 %.
    free = velocity[node] + (kick - world[0].velocity_loss * (velocity[node] + kick))
    motion = advance(world[0], position[node], free)
    position_out[node] = motion.position
    velocity_out[node] = motion.velocity
    if free_velocity_out.shape[0] > 0:
        free_velocity_out[node] = free
    # Written so that NaN is caught too; an integer minimum does not depend on thread order.
    if not (wp.length(motion.velocity) <= world[0].speed_limit):
        wp.atomic_min(first_divergence_out, 0, substep * position.shape[0] + node)
