"""The surface of hands pushes object nodes: a penalty with Coulomb friction, and its adjoint.

At the start of a frame each node gets the nearest triangle of the hands. It is pushed out of the
plane of that triangle, which moves with the hand, until the frame ends. What a virtual spring
holds is not pushed as well. No sum depends on the order of threads, so the same input gives the
same bits.
"""

import warp as wp

from physhandi.simulation.kernels.contacts import SLIDING_SPEED
from physhandi.simulation.kernels.integration import spring_sum
from physhandi.simulation.kernels.push_constants import (
    FARTHEST_FACE,
    LEAVING_SPEED,
    MOST_ASIDE,
    MOST_DEPTH,
    SAME_DISTANCE,
)
from physhandi.simulation.kernels.world import World

wp.set_module_options({"enable_backward": False})

SMALLEST_AREA = wp.constant(1.0e-12)
"""Least double area of a triangle that is divided by [m²]."""


@wp.struct
class Touch:
    """A node beside the plane of its triangle."""

    normal: wp.vec3
    """Unit normal, out of the hand."""
    depth: wp.float32
    """How far the node is inside [m]."""
    offset: wp.vec3
    """From the triangle's first corner to the node [m]."""
    edge_1: wp.vec3
    """From the first corner to the second [m]."""
    edge_2: wp.vec3
    """From the first corner to the third [m]."""
    twice_area: wp.float32
    """Twice the area of the triangle [m²]."""
    rate: wp.vec3
    """Velocity of the surface beside the node [m/s]."""


@wp.struct
class Push:
    """How hard a hand pushes a node in a substep, with the terms of the law in `push_nodes`."""

    acts: wp.bool
    """Whether it pushes; if not, the fields below mean nothing."""
    touch: Touch
    slip: wp.vec3
    """The law's u: velocity past the surface after this substep without a push [m/s]."""
    leaving: wp.float32
    """The part of it out of the hand, u·n [m/s]."""
    sliding: wp.vec3
    """The part of it along the surface, t [m/s]."""
    speed: wp.float32
    """Length of that part, at least `SLIDING_SPEED` [m/s]."""
    load: wp.float32
    """The law's q [N]."""
    room: wp.float32
    """The law's 1 - u·n / s."""
    yields: wp.float32
    """The law's 1 + dt q / s."""
    pressure: wp.float32
    """The law's N [N]."""


@wp.func
def nearest_weights(point: wp.vec3, edge_1: wp.vec3, edge_2: wp.vec3):
    """Return the barycentric weights of the point of a triangle that is nearest to a point.

    Args:
        point: Seen from the first corner.
        edge_1: Second corner, seen from the first.
        edge_2: Third corner, seen from the first.
    """
    a, b, c = wp.dot(edge_1, edge_1), wp.dot(edge_1, edge_2), wp.dot(edge_2, edge_2)
    along_1, along_2 = wp.dot(edge_1, point), wp.dot(edge_2, point)
    square = wp.max(a * c - b * b, 1.0e-30)
    v = (c * along_1 - b * along_2) / square
    w = (a * along_2 - b * along_1) / square
    if v >= 0.0 and w >= 0.0 and v + w <= 1.0:
        return wp.vec3(1.0 - v - w, v, w)
    # Outside: the nearest point of the three edges.
    on_1 = wp.clamp(along_1 / wp.max(a, 1.0e-30), 0.0, 1.0)
    on_2 = wp.clamp(along_2 / wp.max(c, 1.0e-30), 0.0, 1.0)
    third = edge_2 - edge_1
    on_3 = wp.clamp(wp.dot(third, point - edge_1) / wp.max(wp.dot(third, third), 1.0e-30), 0.0, 1.0)
    best = wp.vec3(1.0 - on_1, on_1, 0.0)
    nearest = wp.length_sq(point - on_1 * edge_1)
    distance = wp.length_sq(point - on_2 * edge_2)
    if distance < nearest:
        nearest = distance
        best = wp.vec3(1.0 - on_2, 0.0, on_2)
    if wp.length_sq(point - edge_1 - on_3 * third) < nearest:
        best = wp.vec3(0.0, 1.0 - on_3, on_3)
    return best


@wp.kernel
def mark_held(
    object_spring_count: int,
    # Model:
    spring_nodes: wp.array[wp.vec2i],
    stiffness: wp.array[float],
    # Changed in place:
    is_held_out: wp.array[int],
):
    """Mark the nodes that a virtual spring with stiffness holds (one thread per virtual spring)."""
    spring = object_spring_count + wp.tid()
    if stiffness[spring] > 0.0:
        ends = spring_nodes[spring]
        # All threads that write here write the same.
        is_held_out[wp.min(ends[0], ends[1])] = 1


@wp.kernel
def find_faces(
    # Model:
    hand_face: wp.array[wp.vec3i],
    shift: wp.array[wp.vec3],
    is_held: wp.array[int],
    # State in:
    position: wp.array[wp.vec3],
    control: wp.array[wp.vec3],
    # State out:
    face_out: wp.array[int],
    weight_out: wp.array[wp.vec3],
):
    """Find the triangle that may push each node, -1 for none (one thread per node).

    `weight_out` are the barycentric weights of the triangle's point beside the node.
    """
    node = wp.tid()
    face_out[node] = -1
    if is_held[node] == 1:
        return
    nearest = float(1.0e30)
    highest = float(0.0)
    nearest_face = int(-1)
    nearest_weight = wp.vec3(0.0, 0.0, 0.0)
    for face in range(hand_face.shape[0]):
        corners = hand_face[face]
        first = control[corners[0]] - shift[corners[0]]
        edge_1 = control[corners[1]] - shift[corners[1]] - first
        edge_2 = control[corners[2]] - shift[corners[2]] - first
        point = position[node] - first
        longest = wp.max(wp.length_sq(edge_1), wp.length_sq(edge_2))
        size = wp.sqrt(wp.max(longest, wp.length_sq(edge_2 - edge_1)))
        # No point of a triangle is farther from a corner than its longest edge.
        least = wp.max(wp.length(point) - size, 0.0)
        if least < FARTHEST_FACE * size and least * least <= nearest * (1.0 + SAME_DISTANCE):
            weight = nearest_weights(point, edge_1, edge_2)
            distance = wp.length_sq(point - weight[1] * edge_1 - weight[2] * edge_2)
            height = wp.dot(wp.normalize(wp.cross(edge_1, edge_2)), point)
            is_as_near = distance <= nearest * (1.0 + SAME_DISTANCE)
            is_nearer = distance < nearest * (1.0 - SAME_DISTANCE)
            if is_nearer or (is_as_near and wp.abs(height) > highest):
                nearest = distance
                highest = wp.abs(height)
                nearest_face = int(-1)
                aside = wp.sqrt(wp.max(distance - height * height, 0.0))
                is_within = distance < FARTHEST_FACE * size * FARTHEST_FACE * size
                if is_within and height > -MOST_DEPTH * size and aside < MOST_ASIDE * size:
                    nearest_face = face
                    nearest_weight = weight
    face_out[node] = nearest_face
    weight_out[node] = nearest_weight


@wp.func
def corner_at(
    control: int,
    fraction: float,
    shift: wp.array[wp.vec3],
    control_start: wp.array[wp.vec3],
    control_end: wp.array[wp.vec3],
):
    """Return where a corner of the hand is, a `fraction` of a frame after its start."""
    start = control_start[control]
    return start + fraction * (control_end[control] - start) - shift[control]


@wp.func
def touch_of(
    corners: wp.vec3i,
    weight: wp.vec3,
    fraction: float,
    frame_rate: float,
    position: wp.vec3,
    shift: wp.array[wp.vec3],
    control_start: wp.array[wp.vec3],
    control_end: wp.array[wp.vec3],
):
    """Return how a node is beside its triangle, a `fraction` of a frame after its start."""
    touch = Touch()
    first = corner_at(corners[0], fraction, shift, control_start, control_end)
    touch.edge_1 = corner_at(corners[1], fraction, shift, control_start, control_end) - first
    touch.edge_2 = corner_at(corners[2], fraction, shift, control_start, control_end) - first
    normal = wp.cross(touch.edge_1, touch.edge_2)
    touch.twice_area = wp.max(wp.length(normal), SMALLEST_AREA)
    touch.normal = normal / touch.twice_area
    touch.offset = position - first
    touch.depth = -wp.dot(touch.normal, touch.offset)
    for corner in range(3):
        control = corners[corner]
        way = control_end[control] - control_start[control]
        touch.rate += (frame_rate * weight[corner]) * way
    return touch


@wp.func
def push_of(
    node: int,
    fraction: float,
    frame_rate: float,
    world: World,
    hand_face: wp.array[wp.vec3i],
    shift: wp.array[wp.vec3],
    face: wp.array[int],
    weight: wp.array[wp.vec3],
    position: wp.vec3,
    velocity: wp.vec3,
    force: wp.vec3,
    control_start: wp.array[wp.vec3],
    control_end: wp.array[wp.vec3],
):
    """Return how hard a hand pushes a node on which springs act with a `force`."""
    push = Push()
    if face[node] >= 0:
        push.touch = touch_of(
            hand_face[face[node]],
            weight[node],
            fraction,
            frame_rate,
            position,
            shift,
            control_start,
            control_end,
        )
        normal = push.touch.normal
        kick = world.dt * (force - wp.vec3(0.0, 0.0, world.gravity))
        push.slip = velocity + kick - push.touch.rate
        push.leaving = wp.dot(normal, push.slip)
        push.acts = push.touch.depth > 0.0 and push.leaving < LEAVING_SPEED
        push.load = world.push_stiffness * push.touch.depth
        push.room = 1.0 - push.leaving / LEAVING_SPEED
        push.yields = 1.0 + world.dt * push.load / LEAVING_SPEED
        push.pressure = push.load * push.room / push.yields
        push.sliding = push.slip - push.leaving * normal
        push.speed = wp.max(wp.length(push.sliding), SLIDING_SPEED)
    return push


@wp.kernel
def push_nodes(
    fraction: float,
    frame_rate: float,
    # Model:
    world: wp.array[World],
    entry_start: wp.array[int],
    entry: wp.array[int],
    hand_face: wp.array[wp.vec3i],
    shift: wp.array[wp.vec3],
    face: wp.array[int],
    weight: wp.array[wp.vec3],
    # State in:
    position: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
    pull: wp.array[wp.vec3],
    control_start: wp.array[wp.vec3],
    control_end: wp.array[wp.vec3],
    # State out:
    force_out: wp.array[wp.vec3],
):
    """Write the force of springs and hands on each object node (one thread per node).

    With u the velocity past the surface that springs and gravity alone would lead to, and with
    q = k depth, the push is N n, N = q max(0, 1 - u·n / s) / (1 + dt q / s). For the velocity u'
    that it leads to this is q (1 - u'·n / s) (Hunt and Crossley, Coefficient of restitution
    interpreted as damping in vibroimpact, 1975): it takes energy, never pulls, and is damped
    stably for any q. The friction is -min(μ N, |t| / dt) t / |t|, with t the part of u along the
    surface: what it can stop does not slide at all.
    """
    node = wp.tid()
    force = spring_sum(node, entry_start, entry, pull)
    push = push_of(
        node,
        fraction,
        frame_rate,
        world[0],
        hand_face,
        shift,
        face,
        weight,
        position[node],
        velocity[node],
        force,
        control_start,
        control_end,
    )
    if push.acts:
        grip = wp.min(world[0].hand_friction * push.pressure, push.speed / world[0].dt)
        force += push.pressure * push.touch.normal - (grip / push.speed) * push.sliding
    force_out[node] = force


@wp.kernel
def push_adjoint(
    fraction: float,
    frame_rate: float,
    # Model:
    world: wp.array[World],
    entry_start: wp.array[int],
    entry: wp.array[int],
    hand_face: wp.array[wp.vec3i],
    shift: wp.array[wp.vec3],
    face: wp.array[int],
    weight: wp.array[wp.vec3],
    # State in:
    position: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
    pull: wp.array[wp.vec3],
    control_start: wp.array[wp.vec3],
    control_end: wp.array[wp.vec3],
    # Adjoint, changed in place:
    position_bar_out: wp.array[wp.vec3],
    velocity_bar_out: wp.array[wp.vec3],
    force_bar_out: wp.array[wp.vec3],
    # Adjoint out:
    corner_bar_out: wp.array2d[wp.vec3],
    corner_rate_bar_out: wp.array2d[wp.vec3],
):
    """Carry the adjoint of the force of springs and hands back through `push_nodes`.

    What the corners of each node's triangle get is written in rows of three. The triangle and the
    weights count as given.
    """
    node = wp.tid()
    for corner in range(3):
        corner_bar_out[node, corner] = wp.vec3(0.0, 0.0, 0.0)
        corner_rate_bar_out[node, corner] = wp.vec3(0.0, 0.0, 0.0)
    force = spring_sum(node, entry_start, entry, pull)
    push = push_of(
        node,
        fraction,
        frame_rate,
        world[0],
        hand_face,
        shift,
        face,
        weight,
        position[node],
        velocity[node],
        force,
        control_start,
        control_end,
    )
    if not push.acts:
        return
    touch, slip, leaving = push.touch, push.slip, push.leaving
    normal, sliding, speed = touch.normal, push.sliding, push.speed
    load, room, yields, pressure = push.load, push.room, push.yields, push.pressure
    friction, dt = world[0].hand_friction, world[0].dt
    force_bar = force_bar_out[node]

    pressure_bar = wp.dot(normal, force_bar)
    normal_bar = pressure * force_bar
    sliding_bar = -(1.0 / dt) * force_bar
    if friction * pressure < speed / dt:
        along = sliding / speed
        across = wp.dot(along, force_bar)
        pressure_bar -= friction * across
        sliding_bar = -(friction * pressure / speed) * (force_bar - across * along)
    # t = u - (u·n) n, then N of q and u·n, then q = -k n·(x - p).
    leaving_bar = -wp.dot(normal, sliding_bar) - load / (LEAVING_SPEED * yields) * pressure_bar
    normal_bar += leaving_bar * slip - leaving * sliding_bar
    slip_bar = sliding_bar + leaving_bar * normal
    depth_bar = world[0].push_stiffness * room / (yields * yields) * pressure_bar
    normal_bar -= depth_bar * touch.offset
    offset_bar = -depth_bar * normal

    # n = m / |m| with m = e_1 x e_2.
    cross_bar = (normal_bar - wp.dot(normal, normal_bar) * normal) / touch.twice_area
    edge_1_bar = wp.cross(touch.edge_2, cross_bar)
    edge_2_bar = wp.cross(cross_bar, touch.edge_1)
    corner_bar_out[node, 0] = -offset_bar - edge_1_bar - edge_2_bar
    corner_bar_out[node, 1] = edge_1_bar
    corner_bar_out[node, 2] = edge_2_bar
    for corner in range(3):
        corner_rate_bar_out[node, corner] = -weight[node][corner] * slip_bar
    position_bar_out[node] += offset_bar
    velocity_bar_out[node] += slip_bar
    force_bar_out[node] = force_bar + dt * slip_bar


@wp.kernel
def gather_corners(
    fraction: float,
    frame_rate: float,
    # Model:
    corner_start: wp.array[int],
    corner: wp.array[int],
    # Adjoint in:
    corner_bar: wp.array[wp.vec3],
    corner_rate_bar: wp.array[wp.vec3],
    # Adjoint, changed in place:
    control_start_bar_out: wp.array[wp.vec3],
    control_end_bar_out: wp.array[wp.vec3],
):
    """Add what a corner of the hand got from all nodes (one thread per control node)."""
    control = wp.tid()
    place_bar = wp.vec3(0.0, 0.0, 0.0)
    rate_bar = wp.vec3(0.0, 0.0, 0.0)
    for place in range(corner_start[control], corner_start[control + 1]):
        place_bar += corner_bar[corner[place]]
        rate_bar += corner_rate_bar[corner[place]]
    control_start_bar_out[control] += (1.0 - fraction) * place_bar - frame_rate * rate_bar
    control_end_bar_out[control] += fraction * place_bar + frame_rate * rate_bar
