"""Float64 NumPy oracle of the spring-mass simulator, written from the equations alone."""

from dataclasses import dataclass

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
    gravity: float = 9.81
    frame_rate: float = 30.0
    substeps: int = 667
    moves: bool = True  # dashpots see the control velocity


def spring_force(scene, x, v):
    """Force on every node, by a dense incidence matrix (spring x node)."""
    count = len(scene.springs)
    incidence = np.zeros((count, len(x)))
    incidence[np.arange(count), scene.springs[:, 0]] = -1.0
    incidence[np.arange(count), scene.springs[:, 1]] += 1.0
    gap, rate = incidence @ x, incidence @ v
    length = np.sqrt((gap**2).sum(1))
    unit = gap / np.maximum(length, 1e-6)[:, None]
    tension = scene.stiffness * (length / scene.rest - 1.0)
    tension = tension + scene.damping * (unit * rate).sum(1)
    return -incidence.T @ (tension[:, None] * unit)


def move_on_ground(scene, x, v, dt):
    """Move one node that may hit the plane: fly to the impact, bounce, fly on."""
    gap = np.inf if scene.ground is None else x[2] - scene.ground
    if not (gap + v[2] * dt < 0.0 and v[2] < -1e-4):
        return x + dt * v, v
    e, mu = np.clip(scene.restitution, 0, 1), np.clip(scene.friction, 0, 2)
    normal = np.array([0.0, 0.0, 1.0])
    v_normal = (v @ normal) * normal
    v_tangent = v - v_normal
    slide = np.sqrt(v_tangent @ v_tangent)
    loss = mu * (1 + e) * np.sqrt(v_normal @ v_normal) / max(slide, 1e-6)
    bounced = max(0.0, 1.0 - loss) * v_tangent - e * v_normal
    impact = gap / -v[2]
    return x + impact * v + (dt - impact) * bounced, bounced


def simulate(scene):
    """Positions and velocities of the object nodes at every frame."""
    dt = 1.0 / (scene.frame_rate * scene.substeps)
    x, v = scene.node.astype(float), scene.velocity.astype(float)
    weight = np.array([0.0, 0.0, -scene.gravity])
    states = [(x, v)]
    for start, end in zip(scene.control[:-1], scene.control[1:], strict=True):
        rate = (end - start) * scene.frame_rate * scene.moves
        for substep in range(scene.substeps):
            held = start + (end - start) * (substep + 1) / scene.substeps
            force = spring_force(scene, np.vstack([x, held]), np.vstack([v, rate]))[: len(x)]
            free = (v + dt * (force + weight)) * np.exp(-dt * scene.drag)
            moved = [move_on_ground(scene, a, b, dt) for a, b in zip(x, free, strict=True)]
            x, v = np.array([m[0] for m in moved]), np.array([m[1] for m in moved])
        states.append((x, v))
    return np.array([s[0] for s in states]), np.array([s[1] for s in states])
