"""Hand-written adjoint of the collisions of object nodes, without atomics.

Which nodes collide is taken as fixed. What a node gains from a pair the other loses, and both
list each other, so that each node gathers what its pairs say of both.
"""

import warp as wp

from physhandi.simulation.kernels.adjoint import before_drag, node_adjoint
from physhandi.simulation.kernels.contacts import SLIDING_SPEED, Motion
from physhandi.simulation.kernels.self_collision.collide import collision_count, is_colliding
from physhandi.simulation.kernels.world import World

wp.set_module_options({"enable_backward": False})


@wp.struct
class BounceAdjoint:
    """Adjoints of what `self_collision.bounce` reads."""

    offset: wp.vec3
    rate: wp.vec3
    restitution: wp.float32
    friction: wp.float32


@wp.func
def bounce_adjoint(world: World, offset: wp.vec3, rate: wp.vec3, gain_bar: wp.vec3):
    """Carry the adjoint of a gain back through `self_collision.bounce`.

    The gain is h v_n n + q v_t with h = (1 + e) / 2, and q = -μ h v_n / |v_t| while the pair
    slides, 1/2 if friction stops it; v_n = w·n < 0 and v_t = w - v_n n.
    """
    restitution = wp.clamp(world.self_restitution, 0.0, 1.0)
    friction = wp.clamp(world.self_friction, 0.0, 2.0)
    length = wp.length(offset)
    normal = offset / length
    closing = wp.dot(rate, normal)
    sliding = rate - closing * normal
    sliding_speed = wp.length(sliding)
    speed = wp.max(sliding_speed, SLIDING_SPEED)
    half = 0.5 * (1.0 + restitution)
    keep = wp.max(0.0, 1.0 + 2.0 * friction * half * closing / speed)
    share = 0.5 * (1.0 - keep)

    before = BounceAdjoint()
    along = wp.dot(normal, gain_bar)
    closing_bar = half * along
    normal_bar = (half * closing) * gain_bar
    sliding_bar = share * gain_bar
    restitution_bar = 0.5 * closing * along
    friction_bar = float(0.0)
    if keep > 0.0:
        across = wp.dot(sliding, gain_bar) / speed
        closing_bar -= friction * half * across
        restitution_bar -= 0.5 * friction * closing * across
        friction_bar = -half * closing * across
        if sliding_speed > SLIDING_SPEED:
            sliding_bar -= (share * across / speed) * sliding
    closing_bar -= wp.dot(sliding_bar, normal)
    normal_bar += closing_bar * rate - closing * sliding_bar
    before.rate = sliding_bar + closing_bar * normal
    before.offset = (normal_bar - wp.dot(normal, normal_bar) * normal) / length
    if world.self_restitution >= 0.0 and world.self_restitution <= 1.0:
        before.restitution = restitution_bar
    if world.self_friction >= 0.0 and world.self_friction <= 2.0:
        before.friction = friction_bar
    return before


@wp.kernel
def ground_adjoint(
    # Model:
    world: wp.array[World],
    clearance: wp.array[float],
    start: wp.array[int],
    candidate: wp.array[int],
    # State in:
    position: wp.array[wp.vec3],
    free_velocity: wp.array[wp.vec3],
    contact_velocity: wp.array[wp.vec3],
    # Adjoint, changed in place:
    position_bar_out: wp.array[wp.vec3],
    velocity_bar_out: wp.array[wp.vec3],
    restitution_bar_out: wp.array[float],
    friction_bar_out: wp.array[float],
    # Adjoint out:
    gain_bar_out: wp.array[wp.vec3],
):
    """Carry the adjoint of a node's new state to before the ground (one thread per node).

    `gain_bar_out` is the adjoint of what each of its collisions gives, by which it divides.
    """
    node = wp.tid()
    after = Motion()
    after.position = position_bar_out[node]
    after.velocity = velocity_bar_out[node]
    touching, velocity = clearance[node], contact_velocity[node]
    before = node_adjoint(world[0], touching, position[node], velocity, after)
    position_bar_out[node] = before.motion.position
    velocity_bar_out[node] = before.motion.velocity
    restitution_bar_out[node] += before.restitution
    friction_bar_out[node] += before.friction
    count = collision_count(node, world[0], start, candidate, position, free_velocity)
    gain_bar_out[node] = before.motion.velocity / wp.max(float(count), 1.0)


@wp.kernel
def collisions_adjoint(
    # Model:
    world: wp.array[World],
    start: wp.array[int],
    candidate: wp.array[int],
    # State in:
    position: wp.array[wp.vec3],
    free_velocity: wp.array[wp.vec3],
    # Adjoint in:
    gain_bar: wp.array[wp.vec3],
    # Adjoint, changed in place:
    position_bar_out: wp.array[wp.vec3],
    velocity_bar_out: wp.array[wp.vec3],
    drag_bar_out: wp.array[float],
    self_restitution_bar_out: wp.array[float],
    self_friction_bar_out: wp.array[float],
    # Adjoint out:
    force_bar_out: wp.array[wp.vec3],
):
    """Carry a node's adjoint to before its collisions, then drag (one thread per node)."""
    node = wp.tid()
    place_bar = wp.vec3(0.0, 0.0, 0.0)
    speed_bar = wp.vec3(0.0, 0.0, 0.0)
    restitution_bar = float(0.0)
    friction_bar = float(0.0)
    for place in range(start[node], start[node + 1]):
        other = candidate[place]
        offset = position[other] - position[node]
        rate = free_velocity[other] - free_velocity[node]
        if is_colliding(world[0], offset, rate):
            pair_bar = gain_bar[node] - gain_bar[other]
            before = bounce_adjoint(world[0], offset, rate, pair_bar)
            place_bar -= before.offset
            speed_bar -= before.rate
            # Both nodes of a pair count it.
            restitution_bar += 0.5 * before.restitution
            friction_bar += 0.5 * before.friction
    free_bar = velocity_bar_out[node] + speed_bar
    old_bar = before_drag(world[0], free_bar)
    position_bar_out[node] += place_bar
    velocity_bar_out[node] = old_bar
    force_bar_out[node] = world[0].dt * old_bar
    drag_bar_out[node] -= world[0].dt * wp.dot(free_velocity[node], free_bar)
    self_restitution_bar_out[node] += restitution_bar
    self_friction_bar_out[node] += friction_bar
