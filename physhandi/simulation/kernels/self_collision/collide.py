"""Collisions of object nodes with each other: restitution and Coulomb friction (physics.md §3.3).

Every node reads the velocities before any collision (Jacobi) and takes the mean over the
nodes that it hits. Only velocities change.
"""

import warp as wp

from physhandi.simulation.kernels.contacts import SLIDING_SPEED, advance
from physhandi.simulation.kernels.integration import free_velocity, is_too_fast, spring_sum
from physhandi.simulation.kernels.world import World

wp.set_module_options({"enable_backward": False})

APPROACH = wp.constant(1.0e-4)
"""A pair whose (x_j - x_i)·(v_j - v_i) is above minus this is not in contact [m²/s]."""


@wp.func
def is_colliding(world: World, offset: wp.vec3, rate: wp.vec3):
    """Return whether two nodes at x_j - x_i collide while this changes at v_j - v_i."""
    reach = world.collision_distance
    return wp.dot(offset, rate) < -APPROACH and wp.length_sq(offset) < reach * reach


@wp.func
def bounce(world: World, offset: wp.vec3, rate: wp.vec3):
    """Return the velocity that the first node of a colliding pair gains; the second loses it.

    With v_n along the offset and v_t across it: (1 + e) v_n / 2 + (1 - a) v_t / 2, where
    a = max(0, 1 - μ (1 + e) |v_n| / |v_t|) of the sliding is kept.
    """
    restitution = wp.clamp(world.self_restitution, 0.0, 1.0)
    friction = wp.clamp(world.self_friction, 0.0, 2.0)
    normal = wp.normalize(offset)
    closing = wp.dot(rate, normal)
    sliding = rate - closing * normal
    speed = wp.max(wp.length(sliding), SLIDING_SPEED)
    keep = wp.max(0.0, 1.0 + friction * (1.0 + restitution) * closing / speed)
    return (0.5 * (1.0 + restitution) * closing) * normal + (0.5 * (1.0 - keep)) * sliding


@wp.func
def collision_count(
    node: int,
    world: World,
    start: wp.array[int],
    candidate: wp.array[int],
    position: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
):
    """Count the nodes that a node collides with."""
    count = int(0)
    for place in range(start[node], start[node + 1]):
        other = candidate[place]
        offset = position[other] - position[node]
        if is_colliding(world, offset, velocity[other] - velocity[node]):
            count += 1
    return count


@wp.func
def collided_velocity(
    node: int,
    world: World,
    start: wp.array[int],
    candidate: wp.array[int],
    position: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
):
    """Return a node's velocity after the mean of its collisions."""
    gain = wp.vec3(0.0, 0.0, 0.0)
    count = int(0)
    for place in range(start[node], start[node + 1]):
        other = candidate[place]
        offset = position[other] - position[node]
        rate = velocity[other] - velocity[node]
        if is_colliding(world, offset, rate):
            gain += bounce(world, offset, rate)
            count += 1
    if count == 0:
        return velocity[node]
    return velocity[node] + gain / float(count)


@wp.kernel
def free_nodes(
    # Model:
    world: wp.array[World],
    entry_start: wp.array[int],
    entry: wp.array[int],
    # State in:
    velocity: wp.array[wp.vec3],
    pull: wp.array[wp.vec3],
    # State out:
    free_velocity_out: wp.array[wp.vec3],
):
    """Write the velocity after springs, gravity and drag (one thread per object node)."""
    node = wp.tid()
    force = spring_sum(node, entry_start, entry, pull)
    free_velocity_out[node] = free_velocity(world[0], velocity[node], force)


@wp.kernel
def collide_nodes(
    substep: int,
    # Model:
    world: wp.array[World],
    clearance: wp.array[float],
    start: wp.array[int],
    candidate: wp.array[int],
    # State in:
    position: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
    # State out:
    contact_velocity_out: wp.array[wp.vec3],
    position_out: wp.array[wp.vec3],
    velocity_out: wp.array[wp.vec3],
    first_divergence_out: wp.array[int],
):
    """Collide, then move each object node, with the ground (one thread per node).

    Other threads read `position` and `velocity`, so the outputs must not be these.
    `contact_velocity_out` is the velocity between both contacts, which the adjoint needs; it
    may be empty.
    """
    node = wp.tid()
    collided = collided_velocity(node, world[0], start, candidate, position, velocity)
    motion = advance(world[0], clearance[node], position[node], collided)
    position_out[node] = motion.position
    velocity_out[node] = motion.velocity
    if contact_velocity_out.shape[0] > 0:
        contact_velocity_out[node] = collided
    if is_too_fast(world[0], motion.velocity):
        wp.atomic_min(first_divergence_out, 0, substep * position.shape[0] + node)
