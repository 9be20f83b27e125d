"""Bending and twisting of a rope: the force of a discrete elastic rod with quasi-static twist.

Bergou et al., Discrete elastic rods (2008) and Discrete viscous threads (2010). Vertex i lies
between the edges i - 1 and i, which have tangents t and material axes m¹ and m² = t x m¹. With the
binormal κb = 2 t_{i-1} x t_i / χ, χ = 1 + t_{i-1}·t_i, and m̄ the mean over both edges, its
curvature is κ = (κb·m̄², -κb·m̄¹), and its energy (B / 2h) |κ - h κ⁰|² + (G / 2h) (θ_i - θ_{i-1})²
with h the mean length of the edges at rest.

The gripper holds the axes of the first edge. The angle θ turns those of every other edge away from
axes that are carried to it along the rope without twist. A rope has next to no inertia about
itself, so in each substep the angles take the way on which moments balance; the last edge is free.
"""

import warp as wp

from physhandi.simulation.kernels.springs import end_position, end_velocity
from physhandi.simulation.kernels.world import World

wp.set_module_options({"enable_backward": False})

SMALLEST = wp.constant(1.0e-6)
"""Least length [m], χ and stiffness [N·m] that is divided by; what is folded flat has no χ."""


@wp.struct
class RodMaterial:
    """How a rope bends and twists; one element of an array on the device."""

    held_by: wp.int32
    """Number, among all nodes, of the control node beside the first vertex that holds the axes."""
    stiffness: wp.float32
    """B [N·m²]."""
    damping: wp.float32
    """Time τ for which a changing curvature counts as bending [s]."""
    twist_stiffness: wp.float32
    """G [N·m²]."""


@wp.func
def across(axis: wp.vec3, tangent: wp.vec3):
    """Return the unit vector across a tangent that is nearest to an axis."""
    return wp.normalize(axis - wp.dot(axis, tangent) * tangent)


@wp.func
def carried(axis: wp.vec3, before: wp.vec3, behind: wp.vec3):
    """Carry an axis from one tangent to the next one without twist."""
    chi = wp.max(1.0 + wp.dot(before, behind), SMALLEST)
    # Rounding would add up along the rope if it were not taken out at every edge.
    return across(axis - (wp.dot(axis, behind) / chi) * (before + behind), behind)


@wp.func
def turn_slope(binormal: wp.vec3, axis_1: wp.vec3, axis_2: wp.vec3):
    """Return the derivative of a vertex's curvature by the angle of one of its edges."""
    return wp.vec2(-0.5 * wp.dot(binormal, axis_1), -0.5 * wp.dot(binormal, axis_2))


@wp.func
def edge_rate(
    curvature: wp.vec2,
    mean_1: wp.vec3,
    mean_2: wp.vec3,
    middle: wp.vec3,
    other: wp.vec3,
    turning: wp.vec3,
):
    """Return how fast one edge's motion changes a vertex's curvature while its axes do not spin.

    Args:
        curvature: κ.
        mean_1: 2 m̄¹ / χ; with a minus for the edge behind the vertex.
        mean_2: 2 m̄² / χ, likewise.
        middle: (t_{i-1} + t_i) / χ.
        other: Tangent of the other edge.
        turning: Velocity of the edge's end against its start, by its length [1/s].
    """
    along = wp.dot(middle, turning)
    return wp.vec2(
        wp.dot(wp.cross(other, mean_2), turning) - curvature[0] * along,
        -wp.dot(wp.cross(other, mean_1), turning) - curvature[1] * along,
    )


@wp.kernel
def bend_rod(
    fraction: float,
    # Model:
    world: wp.array[World],
    material: wp.array[RodMaterial],
    node: wp.array[int],
    length: wp.array[float],
    natural_curvature: wp.array[wp.vec2],
    # State in:
    position: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
    control_start: wp.array[wp.vec3],
    control_end: wp.array[wp.vec3],
    # State, changed in place:
    angle_out: wp.array[float],
    # Scratch, one a vertex and the edge behind it:
    axis_out: wp.array[wp.vec3],
    binormal_out: wp.array[wp.vec3],
    moment_out: wp.array[wp.vec2],
    diagonal_out: wp.array[float],
    beside_out: wp.array[float],
    turn_out: wp.array[float],
    # State out:
    first: int,
    force_out: wp.array[wp.vec3],
):
    """Turn the rope's axes and write the force on each vertex, from place `first` on (one thread).

    Moments are r = (B/h) (κ - h κ⁰ + τ dκ/dt) with the curvature after the turn. The derivative of
    the energy by an edge e is [-(r·κ) t̃ ± t' x (r¹ m̃² - r² m̃¹)] / |e| + T κb / 2|e|, with t' of the
    other edge, + for the edge before the vertex, T = (G/h) (θ_i - θ_{i-1}), and a tilde for the
    mean over both edges, 2/χ times.
    """
    edges = node.shape[0] - 1
    rate = world[0].control_rate
    held = end_position(material[0].held_by, fraction, position, control_start, control_end)
    held_velocity = end_velocity(material[0].held_by, rate, velocity, control_start, control_end)
    elastic = world[0].stiffness_scale * material[0].stiffness
    viscous = material[0].stiffness * material[0].damping
    # A turn within the substep changes the curvature, and does so at once.
    turned = elastic + viscous / world[0].dt
    twisting = world[0].stiffness_scale * material[0].twist_stiffness

    # Along the rope: axes, curvatures, moments before the turn, and what balances them.
    edge = position[node[1]] - position[node[0]]
    inverse = 1.0 / wp.max(wp.length(edge), SMALLEST)
    tangent = inverse * edge
    turning = inverse * (velocity[node[1]] - velocity[node[0]])
    arm = held - position[node[0]]
    straight = across(arm, tangent)
    axis_1 = straight
    axis_2 = wp.cross(tangent, axis_1)
    axis_out[0] = axis_1
    swing = held_velocity - velocity[node[0]] - wp.dot(arm, tangent) * turning
    spin = wp.dot(swing, axis_2) / wp.max(wp.dot(arm, axis_1), SMALLEST)
    for i in range(1, edges):
        before = tangent
        before_1 = axis_1
        before_2 = axis_2
        before_turning = turning
        before_spin = spin
        edge = position[node[i + 1]] - position[node[i]]
        inverse = 1.0 / wp.max(wp.length(edge), SMALLEST)
        tangent = inverse * edge
        turning = inverse * (velocity[node[i + 1]] - velocity[node[i]])
        straight = carried(straight, before, tangent)
        axis_1 = wp.cos(angle_out[i]) * straight + wp.sin(angle_out[i]) * wp.cross(
            tangent, straight
        )
        axis_2 = wp.cross(tangent, axis_1)
        chi = wp.max(1.0 + wp.dot(before, tangent), SMALLEST)
        bend = (2.0 / chi) * wp.cross(before, tangent)
        spin = before_spin - 0.5 * wp.dot(bend, before_turning + turning)
        mean_1 = (before_1 + axis_1) / chi
        mean_2 = (before_2 + axis_2) / chi
        middle = (before + tangent) / chi
        curvature = 0.5 * chi * wp.vec2(wp.dot(bend, mean_2), -wp.dot(bend, mean_1))
        slope_before = turn_slope(bend, before_1, before_2)
        slope = turn_slope(bend, axis_1, axis_2)
        change = edge_rate(curvature, mean_1, mean_2, middle, tangent, before_turning)
        change += edge_rate(curvature, -mean_1, -mean_2, middle, before, turning)
        change += before_spin * slope_before + spin * slope
        r = (elastic / length[i]) * (curvature - length[i] * natural_curvature[i])
        r += (viscous / length[i]) * change
        torque = twisting / length[i] * (angle_out[i] - angle_out[i - 1])
        axis_out[i] = axis_1
        binormal_out[i] = bend
        moment_out[i] = r
        share = turned / length[i]
        resist = twisting / length[i]
        if i > 1:
            # Where turning further would lower the slope, it is taken to stay the same.
            diagonal_out[i - 1] += share * wp.length_sq(slope_before) + resist
            diagonal_out[i - 1] += wp.max(r[0] * slope_before[1] - r[1] * slope_before[0], 0.0)
            turn_out[i - 1] += torque - wp.dot(r, slope_before)
        diagonal_out[i] = SMALLEST + share * wp.length_sq(slope) + resist
        diagonal_out[i] += wp.max(r[0] * slope[1] - r[1] * slope[0], 0.0)
        turn_out[i] = -torque - wp.dot(r, slope)
        beside_out[i] = share * wp.dot(slope_before, slope) - resist
    # The turn of each edge: Gauss elimination of a matrix with one row an edge.
    turn_out[0] = 0.0
    for i in range(2, edges):
        part = beside_out[i] / diagonal_out[i - 1]
        diagonal_out[i] -= part * beside_out[i]
        turn_out[i] -= part * turn_out[i - 1]
    for back in range(1, edges):
        i = edges - back
        if back > 1:
            turn_out[i] -= beside_out[i + 1] * turn_out[i + 1]
        turn_out[i] /= diagonal_out[i]

    # And back: moments after the turn, slopes of the energy by each edge, forces.
    slope_behind = wp.vec3(0.0, 0.0, 0.0)
    for back in range(edges):
        j = edges - 1 - back
        edge = position[node[j + 1]] - position[node[j]]
        tangent = edge / wp.max(wp.length(edge), SMALLEST)
        axis_1 = axis_out[j]
        axis_2 = wp.cross(tangent, axis_1)
        total = wp.vec3(0.0, 0.0, 0.0)
        for side in range(2):
            # The vertex behind the edge, whose other edge is the next one; then that before it.
            i = j + 1 - side
            other_edge = j + 1 - 2 * side
            if i > 0 and i < edges:
                sign = 1.0 - 2.0 * float(side)
                step = position[node[other_edge + 1]] - position[node[other_edge]]
                other = step / wp.max(wp.length(step), SMALLEST)
                other_1 = axis_out[other_edge]
                other_2 = wp.cross(other, other_1)
                bend = binormal_out[i]
                r = moment_out[i]
                r += (turned / length[i] * turn_out[j]) * turn_slope(bend, axis_1, axis_2)
                r += (turned / length[i] * turn_out[other_edge]) * turn_slope(
                    bend, other_1, other_2
                )
                torque = angle_out[i] + turn_out[i] - angle_out[i - 1] - turn_out[i - 1]
                torque *= twisting / length[i]
                chi = wp.max(1.0 + wp.dot(tangent, other), SMALLEST)
                lever = (r[0] * (axis_2 + other_2) - r[1] * (axis_1 + other_1)) / chi
                total += sign * wp.cross(other, lever)
                total -= (0.5 * wp.dot(bend, lever)) * (tangent + other)
                total += (0.5 * torque) * bend
        slope_now = total / wp.max(wp.length(edge), SMALLEST)
        force_out[first + j + 1] = slope_behind - slope_now
        slope_behind = slope_now
    force_out[first] = slope_behind
    for i in range(1, edges):
        angle_out[i] += turn_out[i]
