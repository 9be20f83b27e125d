"""Hand-written adjoint of one substep; a bar (as in x̄) is the derivative of the loss by x.

Backwards through a substep: `nodes_adjoint` undoes contact, drag and integration,
`springs_adjoint` the spring forces, `gather_nodes` hands the result to the springs' ends.
"""

import warp as wp

from physhandi.simulation.kernels.contacts import SLIDING_SPEED, Motion, touches_ground
from physhandi.simulation.kernels.integration import spring_sum
from physhandi.simulation.kernels.springs import end_position, end_velocity
from physhandi.simulation.kernels.world import World

wp.set_module_options({"enable_backward": False})


@wp.struct
class ContactAdjoint:
    """Adjoints of one node's position and velocity, and its share of the coefficients'."""

    motion: Motion
    restitution: wp.float32
    friction: wp.float32


@wp.func
def node_adjoint(
    world: World, clearance: float, position: wp.vec3, velocity: wp.vec3, after: Motion
):
    """Carry adjoints (`after`) back through `contacts.advance`.

    With height z above where it touches, impact time τ = -z/v_z and kept sliding
    s = 1 + μ (1 + e) v_z / |v_t|: v' = (s v_t, -e v_z) and x' = x + v τ + v' (dt - τ).
    """
    before = ContactAdjoint()
    before.motion.position = after.position
    before.motion.velocity = after.velocity + world.dt * after.position
    if not touches_ground(world, clearance, position, velocity):
        return before
    restitution = wp.clamp(world.restitution, 0.0, 1.0)
    friction = wp.clamp(world.friction, 0.0, 2.0)
    sliding = wp.vec3(velocity[0], velocity[1], 0.0)
    sliding_speed = wp.length(sliding)
    speed = wp.max(sliding_speed, SLIDING_SPEED)
    grip = (1.0 + restitution) * velocity[2] / speed
    keep = wp.max(0.0, 1.0 + friction * grip)
    bounced = keep * sliding - wp.vec3(0.0, 0.0, restitution * velocity[2])
    impact = -(position[2] - world.ground_height - clearance) / velocity[2]

    bounced_bar = after.velocity + (world.dt - impact) * after.position
    impact_bar = wp.dot(velocity - bounced, after.position)
    velocity_bar = impact * after.position + keep * wp.vec3(bounced_bar[0], bounced_bar[1], 0.0)
    vertical_bar = -impact_bar * impact / velocity[2] - restitution * bounced_bar[2]
    restitution_bar = -velocity[2] * bounced_bar[2]
    friction_bar = float(0.0)
    if keep > 0.0:
        keep_bar = wp.dot(sliding, bounced_bar)
        friction_bar = grip * keep_bar
        restitution_bar += friction * velocity[2] / speed * keep_bar
        vertical_bar += friction * (1.0 + restitution) / speed * keep_bar
        if sliding_speed > SLIDING_SPEED:
            velocity_bar -= friction * grip * keep_bar / (speed * speed) * sliding
    before.motion.velocity = velocity_bar + wp.vec3(0.0, 0.0, vertical_bar)
    before.motion.position = after.position - wp.vec3(0.0, 0.0, impact_bar / velocity[2])
    if world.restitution >= 0.0 and world.restitution <= 1.0:
        before.restitution = restitution_bar
    if world.friction >= 0.0 and world.friction <= 2.0:
        before.friction = friction_bar
    return before


@wp.func
def before_drag(world: World, free_bar: wp.vec3):
    """Carry the adjoint of a velocity after drag back to before it."""
    return free_bar - world.velocity_loss * free_bar


@wp.kernel
def nodes_adjoint(
    # Model:
    world: wp.array[World],
    clearance: wp.array[float],
    # State in:
    position: wp.array[wp.vec3],
    free_velocity: wp.array[wp.vec3],
    # Adjoint, changed in place:
    position_bar_out: wp.array[wp.vec3],
    velocity_bar_out: wp.array[wp.vec3],
    drag_bar_out: wp.array[float],
    restitution_bar_out: wp.array[float],
    friction_bar_out: wp.array[float],
    # Adjoint out:
    force_bar_out: wp.array[wp.vec3],
):
    """Carry the adjoint of a node's new state to its old state and force (a thread a node)."""
    node = wp.tid()
    after = Motion()
    after.position = position_bar_out[node]
    after.velocity = velocity_bar_out[node]
    before = node_adjoint(world[0], clearance[node], position[node], free_velocity[node], after)
    free_bar = before.motion.velocity
    old_bar = before_drag(world[0], free_bar)
    position_bar_out[node] = before.motion.position
    velocity_bar_out[node] = old_bar
    force_bar_out[node] = world[0].dt * old_bar
    drag_bar_out[node] -= world[0].dt * wp.dot(free_velocity[node], free_bar)
    restitution_bar_out[node] += before.restitution
    friction_bar_out[node] += before.friction


@wp.func
def force_bar_at(node: int, force_bar: wp.array[wp.vec3]):
    """Return the adjoint of the force on a spring's end; nothing depends on a control's."""
    if node < force_bar.shape[0]:
        return force_bar[node]
    return wp.vec3(0.0, 0.0, 0.0)


@wp.kernel
def springs_adjoint(
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
    # Adjoint in:
    force_bar: wp.array[wp.vec3],
    # Adjoint, changed in place:
    log_stiffness_bar_out: wp.array[float],
    damping_bar_out: wp.array[float],
    # Adjoint out:
    offset_bar_out: wp.array[wp.vec3],
    stretch_bar_out: wp.array[wp.vec3],
):
    """Carry force adjoints to each spring's offset x_j - x_i and stretch v_j - v_i.

    With tension T, direction d, closing a = (f̄_i - f̄_j)·d and rate s = (v_j - v_i)·d:
    offset gets (Y/r) a d + (T/L) (f̄ - a d) + (c a/L) (v_j - v_i - s d), stretch gets c a d.
    """
    spring = wp.tid()
    i = spring_nodes[spring][0]
    j = spring_nodes[spring][1]
    offset = end_position(j, fraction, position, control_start, control_end) - end_position(
        i, fraction, position, control_start, control_end
    )
    control_rate = world[0].control_rate
    stretch = end_velocity(j, control_rate, velocity, control_start, control_end) - end_velocity(
        i, control_rate, velocity, control_start, control_end
    )
    length = wp.length(offset)
    inverse = 1.0 / wp.max(length, 1.0e-6)
    direction = inverse * offset
    rate = wp.dot(stretch, direction)
    strain = (length - rest_length[spring]) / rest_length[spring]
    elastic = world[0].stiffness_scale * stiffness[spring]
    tension = elastic * strain + damping[spring] * rate

    pull_bar = force_bar_at(i, force_bar) - force_bar_at(j, force_bar)
    closing = wp.dot(pull_bar, direction)
    dashpot = damping[spring] * closing
    offset_bar_out[spring] = (
        (elastic / rest_length[spring] * closing) * direction
        + (tension * inverse) * (pull_bar - closing * direction)
        + (dashpot * inverse) * (stretch - rate * direction)
    )
    stretch_bar_out[spring] = dashpot * direction
    log_stiffness_bar_out[spring] += closing * elastic * strain
    damping_bar_out[spring] += closing * rate


@wp.kernel
def gather_nodes(
    fraction: float,
    # Model:
    world: wp.array[World],
    entry_start: wp.array[int],
    entry: wp.array[int],
    # Adjoint in:
    offset_bar: wp.array[wp.vec3],
    stretch_bar: wp.array[wp.vec3],
    # Adjoint, changed in place:
    position_bar_out: wp.array[wp.vec3],
    velocity_bar_out: wp.array[wp.vec3],
    control_start_bar_out: wp.array[wp.vec3],
    control_end_bar_out: wp.array[wp.vec3],
):
    """Add what a node's springs say (one thread per object node, then per control node)."""
    node = wp.tid()
    # The first node of a spring enters offset and stretch with a minus sign.
    place_bar = -spring_sum(node, entry_start, entry, offset_bar)
    speed_bar = -spring_sum(node, entry_start, entry, stretch_bar)
    node_count = position_bar_out.shape[0]
    if node < node_count:
        position_bar_out[node] += place_bar
        velocity_bar_out[node] += speed_bar
        return
    control = node - node_count
    by_rate = world[0].control_rate * speed_bar
    control_start_bar_out[control] += (1.0 - fraction) * place_bar - by_rate
    control_end_bar_out[control] += fraction * place_bar + by_rate
