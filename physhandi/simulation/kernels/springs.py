"""The force of each spring."""

import warp as wp

from physhandi.simulation.kernels.world import World

wp.set_module_options({"enable_backward": False})


@wp.func
def end_position(
    node: int,
    fraction: float,
    position: wp.array[wp.vec3],
    control_start: wp.array[wp.vec3],
    control_end: wp.array[wp.vec3],
):
    """Return where a spring's end is; control nodes move on a straight line during a frame."""
    node_count = position.shape[0]
    if node < node_count:
        return position[node]
    start = control_start[node - node_count]
    return start + fraction * (control_end[node - node_count] - start)


@wp.func
def end_velocity(
    node: int,
    control_rate: float,
    velocity: wp.array[wp.vec3],
    control_start: wp.array[wp.vec3],
    control_end: wp.array[wp.vec3],
):
    """Return how fast a spring's end moves."""
    node_count = velocity.shape[0]
    if node < node_count:
        return velocity[node]
    return control_rate * (control_end[node - node_count] - control_start[node - node_count])


@wp.kernel
def pull_springs(
    fraction: float,
    # Model:
    world: wp.array[World],
    spring_nodes: wp.array[wp.vec2i],
    rest_length: wp.array[float],
    stiffness: wp.array[float],
    damping: wp.array[float],
    # State in:
    position: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
    control_start: wp.array[wp.vec3],
    control_end: wp.array[wp.vec3],
    # State out:
    pull_out: wp.array[wp.vec3],
):
    """Write the force on each spring's first node (one thread per spring).

    F = [Y (L / r - 1) + c (v_j - v_i)·d] d; the second node gets -F.
    """
    spring = wp.tid()
    i = spring_nodes[spring][0]
    j = spring_nodes[spring][1]
    offset = end_position(j, fraction, position, control_start, control_end) - end_position(
        i, fraction, position, control_start, control_end
    )
    rate = world[0].control_rate
    stretch = end_velocity(j, rate, velocity, control_start, control_end) - end_velocity(
        i, rate, velocity, control_start, control_end
    )
    length = wp.length(offset)
    inverse = 1.0 / wp.max(length, 1.0e-6)
    # L - r is exact near rest, where L / r - 1 would lose digits.
    strain = (length - rest_length[spring]) / rest_length[spring]
    tension = world[0].stiffness_scale * stiffness[spring] * strain
    tension += damping[spring] * wp.dot(stretch, offset) * inverse
    pull_out[spring] = tension * inverse * offset
