"""Float64 NumPy oracle of the spring-mass simulator, written from the equations alone."""

from dataclasses import dataclass, replace

import numpy as np


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


def incidence(scene, count):
    """Tell which springs leave (-1) and reach (1) which of `count` nodes, spring x node."""
    number = np.arange(len(scene.springs))
    table = np.zeros((len(scene.springs), count))
    table[number, scene.springs[:, 0]] = -1.0
    table[number, scene.springs[:, 1]] += 1.0
    return table


def spring_force(scene, joins, x, v):
    """Force on every node; `joins` is the incidence of all springs."""
    gap, rate = joins @ x, joins @ v
    length = np.sqrt((gap**2).sum(1))
    unit = gap / np.maximum(length, 1e-6)[:, None]
    tension = scene.stiffness * (length / scene.rest - 1.0)
    tension = tension + scene.damping * (unit * rate).sum(1)
    return -joins.T @ (tension[:, None] * unit)


def move_on_ground(scene, x, v, dt, plane):
    """Move nodes that may hit their planes: fly to the impact, bounce, fly on."""
    gap = x[:, 2] - plane
    hits = (gap + v[:, 2] * dt < 0.0) & (v[:, 2] < -1e-4)
    moved, velocity = x + dt * v, v.copy()
    if hits.any():
        e, mu = np.clip(scene.restitution, 0, 1), np.clip(scene.friction, 0, 2)
        v_normal, v_tangent = v[hits] * [0.0, 0.0, 1.0], v[hits] * [1.0, 1.0, 0.0]
        slide = np.sqrt((v_tangent**2).sum(1))
        loss = mu * (1 + e) * np.sqrt((v_normal**2).sum(1)) / np.maximum(slide, 1e-6)
        bounced = np.maximum(0.0, 1.0 - loss)[:, None] * v_tangent - e * v_normal
        impact = (gap[hits] / -v[hits, 2])[:, None]
        moved[hits] = x[hits] + impact * v[hits] + (dt - impact) * bounced
        velocity[hits] = bounced
    return moved, velocity


def candidate_table(scene, x):
    """Which pairs may collide in the frame that starts at x, as a symmetric table."""
    gaps = [np.linalg.norm(p[:, None] - p[None], axis=2) for p in (x, rest_shape(scene))]
    may = gaps[0] < scene.distance
    if not scene.blocks_rest:
        may &= gaps[1] >= scene.distance
    np.fill_diagonal(may, False)
    return may


def rest_shape(scene):
    return scene.node if scene.rest_shape is None else scene.rest_shape


def collisions(scene, may, x, v):
    """Collide all pairs of the table at once: new velocities, and how many pairs collided."""
    gap, rate = x[None] - x[:, None], v[None] - v[:, None]  # of j seen from i
    length = np.sqrt((gap**2).sum(2))
    hits = may & (length < scene.distance) & ((gap * rate).sum(2) < -1e-4)
    normal = gap / np.where(hits, length, 1.0)[..., None]
    e, mu = np.clip(scene.self_restitution, 0, 1), np.clip(scene.self_friction, 0, 2)
    v_normal = (rate * normal).sum(2, keepdims=True) * normal
    v_tangent = rate - v_normal
    slide = np.maximum(np.sqrt((v_tangent**2).sum(2, keepdims=True)), 1e-6)
    speed = np.sqrt((v_normal**2).sum(2, keepdims=True))
    kept = np.maximum(0.0, 1.0 - mu * (1 + e) * speed / slide)
    # Both weigh 1 kg, so that 1 / (1/m + 1/m) = 1/2.
    impulse = -(1 + e) * v_normal / 2 + (kept - 1) * v_tangent / 2
    total = np.where(hits[..., None], impulse, 0.0).sum(1)
    return v - total / np.maximum(hits.sum(1), 1)[:, None], int(hits.sum()) // 2


def simulate(scene, counts=None):
    """Positions and velocities of the object nodes at every frame.

    A list given as `counts` gets the number of colliding pairs of every substep.
    """
    dt = 1.0 / (scene.frame_rate * scene.substeps)
    x, v = scene.node.astype(float), scene.velocity.astype(float)
    weight = np.array([0.0, 0.0, -scene.gravity])
    plane = np.full(len(x), -np.inf if scene.ground is None else scene.ground)
    if scene.clearance is not None:
        plane += scene.clearance
    states, joins = [(x, v)], incidence(scene, len(x) + scene.control.shape[1])
    everything = scene
    for frame, (start, end) in enumerate(zip(scene.control[:-1], scene.control[1:], strict=True)):
        if everything.attached is not None:
            begin, leave = everything.attached.T
            on = np.where((begin <= frame) & (frame + 1 <= leave), 1.0, 0.0)
            scene = replace(
                everything, stiffness=everything.stiffness * on, damping=everything.damping * on
            )
        rate = (end - start) * scene.frame_rate * scene.moves
        may = None if scene.distance is None else candidate_table(scene, x)
        for substep in range(scene.substeps):
            held = start + (end - start) * (substep + 1) / scene.substeps
            force = spring_force(scene, joins, np.vstack([x, held]), np.vstack([v, rate]))[: len(x)]
            free = (v + dt * (force + weight)) * np.exp(-dt * scene.drag)
            if may is not None:
                free, count = collisions(scene, may, x, free)
                if counts is not None:
                    counts.append(count)
            x, v = move_on_ground(scene, x, free, dt, plane)
        states.append((x, v))
    return np.array([s[0] for s in states]), np.array([s[1] for s in states])
