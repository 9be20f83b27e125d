"""The kernels of the benchmark's baseline: atomics, several launches a substep.

Only `physhandi.benchmarks.phystwin_like` uses them; Warp derives their backward pass.
"""

import warp as wp


@wp.kernel
def place_baseline_controls(
    fraction: float,
    control_start: wp.array[wp.vec3],
    control_end: wp.array[wp.vec3],
    control_out: wp.array[wp.vec3],
):
    """Interpolate a control node (one thread per control node)."""
    control = wp.tid()
    start = control_start[control]
    control_out[control] = start + (control_end[control] - start) * fraction


@wp.kernel
def add_spring_forces(
    spring_nodes: wp.array[wp.vec2i],
    rest_length: wp.array[float],
    log_stiffness: wp.array[float],
    dashpot: float,
    position: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
    control: wp.array[wp.vec3],
    force_out: wp.array[wp.vec3],
):
    """Add a spring's force to its ends (one thread per spring)."""
    spring = wp.tid()
    i = spring_nodes[spring][0]
    j = spring_nodes[spring][1]
    count = position.shape[0]
    x_i = wp.vec3()
    x_j = wp.vec3()
    v_i = wp.vec3(0.0, 0.0, 0.0)
    v_j = wp.vec3(0.0, 0.0, 0.0)
    if i < count:
        x_i = position[i]
        v_i = velocity[i]
    else:
        x_i = control[i - count]
    if j < count:
        x_j = position[j]
        v_j = velocity[j]
    else:
        x_j = control[j - count]
    length = wp.length(x_j - x_i)
    direction = (x_j - x_i) / wp.max(length, 1.0e-6)
    tension = wp.exp(log_stiffness[spring]) * (length / rest_length[spring] - 1.0)
    pull = (tension + dashpot * wp.dot(v_j - v_i, direction)) * direction
    if i < count:
        wp.atomic_add(force_out, i, pull)
    if j < count:
        wp.atomic_sub(force_out, j, pull)


@wp.kernel
def update_velocity(
    dt: float,
    drag: float,
    gravity: float,
    velocity: wp.array[wp.vec3],
    force: wp.array[wp.vec3],
    velocity_out: wp.array[wp.vec3],
):
    """Apply force, gravity and drag (one thread per object node)."""
    node = wp.tid()
    acceleration = force[node] - wp.vec3(0.0, 0.0, gravity)
    velocity_out[node] = (velocity[node] + acceleration * dt) * wp.exp(-dt * drag)


@wp.kernel
def integrate(
    dt: float,
    ground: float,
    restitution: wp.array[float],
    friction: wp.array[float],
    position: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
    position_out: wp.array[wp.vec3],
    velocity_out: wp.array[wp.vec3],
):
    """Move a node, with contact (one thread per object node)."""
    node = wp.tid()
    x = position[node]
    v = velocity[node]
    height = x[2] - ground
    after = v
    impact = float(0.0)
    if height + v[2] * dt < 0.0 and v[2] < -1.0e-4:
        e = wp.clamp(restitution[0], 0.0, 1.0)
        mu = wp.clamp(friction[0], 0.0, 2.0)
        sliding = wp.vec3(v[0], v[1], 0.0)
        grip = mu * (1.0 + e) * wp.abs(v[2]) / wp.max(wp.length(sliding), 1.0e-6)
        after = wp.max(0.0, 1.0 - grip) * sliding - wp.vec3(0.0, 0.0, e * v[2])
        impact = -height / v[2]
    position_out[node] = x + v * impact + after * (dt - impact)
    velocity_out[node] = after


@wp.kernel
def sum_heights(position: wp.array[wp.vec3], loss_out: wp.array[float]):
    """Give the backward pass something to differentiate (one thread per object node)."""
    wp.atomic_add(loss_out, 0, position[wp.tid()][2])
