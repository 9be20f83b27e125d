"""Float64 NumPy oracle of the spring-mass simulator, written from the equations alone.

Cases of one scene are simulated at once if fields have an axis of cases before their own axes.
"""

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array


@dataclass
class Scene:
    node: np.ndarray  # object nodes, then control nodes: spring ends index into both
    velocity: np.ndarray
    springs: np.ndarray
    rest: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    control: np.ndarray  # (frame, control, 3)
    drag: float = 3.0
    restitution: float = 0.5
    friction: float = 0.3
    ground: float | None = 0.0
    clearance: np.ndarray | None = None  # height above the ground at which each node touches it
    gravity: float = 9.81
    frame_rate: float = 30.0
    substeps: int = 667
    moves: bool = True  # dashpots see the control velocity
    distance: float | None = None  # of self-collision; none switches it off
    self_restitution: float = 0.7
    self_friction: float = 0.3
    blocks_rest: bool = False  # rest neighbours collide too
    rest_shape: np.ndarray | None = None  # object nodes at rest; none for `node`
    attached: np.ndarray | None = None  # (spring, 2): the states between which each spring acts
    hand: np.ndarray | None = None  # triangles of control nodes that push; none switches it off
    push_stiffness: float = 1e5
    hand_friction: float = 0.5
    beside: list | None = None  # of every frame, what `triangles_beside` gave; none to find it


def incidence(scene, count):
    """Tell which springs leave (-1) and reach (1) which of `count` nodes: spring x node, turned."""
    springs = len(scene.springs)
    place = np.repeat(np.arange(springs), 2), scene.springs.ravel()
    table = coo_array((np.tile([-1.0, 1.0], springs), place), shape=(springs, count))
    return table.tocsr(), table.T.tocsr()


def times(table, values):
    """Multiply a sparse table with values whose last axis but one it sums over, in every case."""
    if values.ndim == 2:
        return table @ values
    first = np.moveaxis(values, -2, 0)
    product = table @ first.reshape(len(first), math.prod(first.shape[1:]))
    return np.moveaxis(product.reshape(-1, *first.shape[1:]), 0, -2)


def spring_force(scene, joins, x, v):
    """Force on every node; `joins` is the incidence of all springs."""
    along, into = joins
    gap, rate = times(along, x), times(along, v)
    length = np.sqrt((gap**2).sum(-1))
    unit = gap / np.maximum(length, 1e-6)[..., None]
    tension = scene.stiffness * (length / scene.rest - 1.0)
    tension = tension + scene.damping * (unit * rate).sum(-1)
    return -times(into, tension[..., None] * unit)


def move_on_ground(scene, x, v, dt, plane):
    """Move nodes that may hit their planes: fly to the impact, bounce, fly on."""
    gap = x[..., 2] - plane
    hits = (gap + v[..., 2] * dt < 0.0) & (v[..., 2] < -1e-4)
    moved, velocity = x + dt * v, v.copy()
    if hits.any():
        e, mu = np.clip(scene.restitution, 0, 1), np.clip(scene.friction, 0, 2)
        if hits.ndim > 1:
            e, mu = (np.broadcast_to(each[..., None], hits.shape)[hits] for each in (e, mu))
        before = v[hits]
        speed = -before[:, 2]
        slide = np.sqrt(before[:, 0] ** 2 + before[:, 1] ** 2)
        remains = np.maximum(0.0, 1.0 - mu * (1 + e) * speed / np.maximum(slide, 1e-6))
        bounced = before * remains[:, None]
        bounced[:, 2] = e * speed
        impact = (gap[hits] / speed)[:, None]
        moved[hits] = x[hits] + impact * before + (dt - impact) * bounced
        velocity[hits] = bounced
    return moved, velocity


def candidate_table(scene, x):
    """Which pairs may collide in the frame that starts at x, as a symmetric table."""
    gaps = [
        np.linalg.norm(p[..., :, None, :] - p[..., None, :, :], axis=-1)
        for p in (x, rest_shape(scene))
    ]
    may = (gaps[0] < scene.distance) & ~np.eye(x.shape[-2], dtype=bool)
    return may if scene.blocks_rest else may & (gaps[1] >= scene.distance)


def rest_shape(scene):
    return scene.node if scene.rest_shape is None else scene.rest_shape


def collisions(scene, may, x, v):
    """Collide all pairs of the table at once: new velocities, and how many pairs collided."""
    *case, i, j = pairs = np.nonzero(may)
    gap, rate = (value[(*case, j)] - value[(*case, i)] for value in (x, v))  # of j seen from i
    length = np.sqrt((gap**2).sum(-1))
    hits = (length < scene.distance) & ((gap * rate).sum(-1) < -1e-4)
    *case, i, _ = (place[hits] for place in pairs)
    rate, normal = rate[hits], gap[hits] / length[hits][:, None]
    e, mu = np.clip(scene.self_restitution, 0, 1), np.clip(scene.self_friction, 0, 2)
    e, mu = (np.broadcast_to(each, may.shape[:-2])[tuple(case)][..., None] for each in (e, mu))
    v_normal = (rate * normal).sum(-1, keepdims=True) * normal
    v_tangent = rate - v_normal
    slide = np.maximum(np.sqrt((v_tangent**2).sum(-1, keepdims=True)), 1e-6)
    speed = np.sqrt((v_normal**2).sum(-1, keepdims=True))
    kept = np.maximum(0.0, 1.0 - mu * (1 + e) * speed / slide)
    # Both weigh 1 kg, so that 1 / (1/m + 1/m) = 1/2.
    impulse = -(1 + e) * v_normal / 2 + (kept - 1) * v_tangent / 2
    total, count = np.zeros(v.shape), np.zeros(v.shape[:-1], dtype=int)
    np.add.at(total, (*case, i), impulse)
    np.add.at(count, (*case, i), 1)
    return v - total / np.maximum(count, 1)[..., None], count.sum(-1) // 2


def nearest_of(corners, point):
    """Weights of each triangle's point nearest to each point, and how far that is.

    Of the least squares of the triangle, its sides and its corners, the nearest is taken that has
    no negative weight.
    """
    shape = len(point), len(corners)
    least, best = np.full(shape, np.inf), np.zeros((*shape, 3))
    for chosen in ([0, 1, 2], [0, 1], [0, 2], [1, 2], [0], [1], [2]):
        base = corners[:, chosen[0]]
        sides = np.swapaxes(corners[:, chosen[1:]] - base[:, None], 1, 2)
        part = np.einsum("tki,nti->ntk", np.linalg.pinv(sides), point[:, None] - base)
        weight = np.zeros((*shape, 3))
        weight[..., chosen[0]], weight[..., chosen[1:]] = 1.0 - part.sum(-1), part
        gap = np.linalg.norm(point[:, None] - np.einsum("ntk,tki->nti", weight, corners), axis=2)
        nearer = (weight.min(-1) >= 0.0) & (gap < least)
        least[nearer], best[nearer] = gap[nearer], weight[nearer]
    return best, least


def triangles_beside(scene, x, place):
    """Which triangle may push each node in a frame that starts like this (-1: none), and where."""
    held = {min(ends) for ends, k in zip(scene.springs, scene.stiffness, strict=True)
            if max(ends) >= len(x) and k > 0.0}  # fmt: skip
    corners = place[scene.hand]
    weights, gaps = nearest_of(corners, x)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    heights = ((x[:, None] - corners[:, 0]) * normal).sum(2)
    sizes = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    least = gaps.min(axis=1, keepdims=True)
    same = gaps**2 <= least**2 * (1 + 1e-4)
    best = np.where(same, np.abs(heights), -1.0).argmax(axis=1)
    node = np.arange(len(x))
    gap, height, size = gaps[node, best], heights[node, best], sizes[best]
    aside = np.sqrt(np.maximum(gap**2 - height**2, 0.0))
    beside = (gap < 6 * size) & (height > -3 * size) & (aside < 0.7 * size)
    beside &= ~np.isin(node, list(held))
    return np.where(beside, best, -1), np.where(beside[:, None], weights[node, best], 0.0)


def pushes(scene, beside, state, force, held, rate):
    """Force of the hand on every object node; `force` is that of springs, `rate` the hand's."""
    x, v = state
    dt = 1.0 / (scene.frame_rate * scene.substeps)
    number, weight = beside
    pushed = np.flatnonzero(number >= 0)
    first, second, third = (held[..., scene.hand[number[pushed], i], :] for i in range(3))
    normal = np.cross(second - first, third - first)
    normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    depth = -((x[..., pushed, :] - first) * normal).sum(-1)
    surface = sum(
        weight[pushed, i, None] * rate[..., scene.hand[number[pushed], i], :] for i in range(3)
    )
    slip = v[..., pushed, :] + dt * (force[..., pushed, :] - [0.0, 0.0, scene.gravity]) - surface
    leaving = (slip * normal).sum(-1)
    # The force that it has with the velocity that it leads to: N = q (1 - (u + dt N) / 0.1 m/s).
    load = scene.push_stiffness * np.maximum(depth, 0.0)
    size = np.maximum((load - load * leaving / 0.1) / (1.0 + dt * load / 0.1), 0.0)
    sliding = slip - leaving[..., None] * normal
    speed = np.maximum(np.linalg.norm(sliding, axis=-1), 1e-6)
    grip = np.minimum(scene.hand_friction * size, speed / dt)
    total = np.zeros(np.broadcast_shapes(x.shape, v.shape))
    total[..., pushed, :] = size[..., None] * normal - (grip / speed)[..., None] * sliding
    return total


def simulate(scene, counts=None, beside=None):
    """Positions and velocities of the object nodes at every frame.

    A list given as `counts` gets the number of colliding pairs of every substep, one given as
    `beside` the triangles that may push in every frame. Cases come first.
    """
    dt = 1.0 / (scene.frame_rate * scene.substeps)
    shape = (*cases(scene), *scene.node.shape[-2:])
    x, v = (np.broadcast_to(s, shape).astype(float) for s in (scene.node, scene.velocity))
    weight = np.array([0.0, 0.0, -scene.gravity])
    count = shape[-2]
    plane = np.full(count, -np.inf if scene.ground is None else scene.ground)
    if scene.clearance is not None:
        plane += scene.clearance
    drag = np.exp(-dt * np.asarray(scene.drag))[..., None, None]
    controls = scene.control.shape[-2]
    states, joins = [(x, v)], incidence(scene, count + controls)
    held_at = np.moveaxis(scene.control, -3, 0)
    everything = scene
    for frame, (start, end) in enumerate(itertools.pairwise(held_at)):
        if everything.attached is not None:
            begin, leave = everything.attached.T
            on = np.where((begin <= frame) & (frame + 1 <= leave), 1.0, 0.0)
            scene = replace(
                everything, stiffness=everything.stiffness * on, damping=everything.damping * on
            )
        rate = (end - start) * scene.frame_rate * scene.moves
        may = None if scene.distance is None else candidate_table(scene, x)
        near = None
        if scene.hand is not None:
            given = scene.beside
            near = triangles_beside(scene, x, start) if given is None else given[frame]
            if beside is not None:
                beside.append(near)
        for substep in range(scene.substeps):
            held = start + (end - start) * (substep + 1) / scene.substeps
            force = spring_force(scene, joins, joined(x, held), joined(v, rate))[..., :count, :]
            if near is not None:
                moving = (end - start) * scene.frame_rate
                force = force + pushes(scene, near, (x, v), force, held, moving)
            free = (v + dt * (force + weight)) * drag
            if may is not None:
                free, collided = collisions(scene, may, x, free)
                if counts is not None:
                    counts.append(collided)
            x, v = move_on_ground(scene, x, free, dt, plane)
        states.append((x, v))
    return np.stack([s[0] for s in states], -3), np.stack([s[1] for s in states], -3)


def cases(scene):
    """Give the shape of the axes of cases: of one scene alone, none."""
    own_axes = {"node": 2, "velocity": 2, "control": 3, "stiffness": 1, "damping": 1}
    own_axes |= dict.fromkeys(("drag", "restitution", "friction"), 0)
    own_axes |= dict.fromkeys(("self_restitution", "self_friction"), 0)
    shapes = ((np.shape(getattr(scene, name)), axes) for name, axes in own_axes.items())
    return np.broadcast_shapes(*(shape[: len(shape) - axes] for shape, axes in shapes))


def joined(nodes, controls):
    """Put object nodes and control nodes into one array."""
    controls = np.broadcast_to(controls, (*nodes.shape[:-2], *controls.shape[-2:]))
    return np.concatenate([nodes, controls], axis=-2)
