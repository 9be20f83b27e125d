"""How long a substep may be before the springs explode."""

import math

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.sparse import csr_array

from physhandi.simulation.model import SimulationParameters, SpringMassModel

_POWER_ITERATIONS = 400
_POWER_TOLERANCE = 1e-7


def largest_stable_step(
    model: SpringMassModel,
    parameters: SimulationParameters,
    control: Float[ndarray, "control 3"] | None = None,
) -> float:
    """Estimate the longest substep that semi-implicit Euler survives [s].

    A mode with stiffness k and damping c (unit mass) is stable if ``dt² k + 2 dt c < 4``; the
    stiffest mode of all springs is found by power iteration at frame 0. Contact, drag and
    large rotations are not included.

    Args:
        model: Springs and material.
        parameters: For `stiffness_scale`.
        control: Where the control nodes are at frame 0 [m]. Left out, each virtual spring is
            taken to act in all directions, which errs on the safe side.

    Returns:
        The step; infinity if nothing is stiff or damped.
    """
    stretch, spring = _stretch_matrix(model, control)
    stiffness = parameters.stiffness_scale * model.stiffness.astype(np.float64) / model.rest_length
    stiffness = stiffness[spring]
    damping = model.damping.astype(np.float64)[spring]
    if not np.any(stiffness > 0.0) and not np.any(damping > 0.0):
        return math.inf
    mode = np.random.default_rng(0).standard_normal(3 * model.node_count)
    mode /= np.linalg.norm(mode)
    step = math.inf
    for _ in range(_POWER_ITERATIONS):
        strain = stretch @ mode
        squared = strain * strain
        previous, step = step, _critical_step(float(squared @ stiffness), float(squared @ damping))
        if abs(step - previous) <= _POWER_TOLERANCE * step:
            break
        mode = stretch.T @ ((step * stiffness + 2.0 * damping) * strain)
        mode /= np.linalg.norm(mode)
    return step


def stable_substeps(
    model: SpringMassModel,
    parameters: SimulationParameters,
    control: Float[ndarray, "control 3"] | None = None,
    *,
    safety: float = 1.25,
) -> int:
    """Return how many substeps a frame needs, with a margin for motion away from frame 0.

    Args:
        model: Springs and material.
        parameters: For `simulated_frame_rate` and `stiffness_scale`.
        control: Where the control nodes are at frame 0 [m]; see `largest_stable_step`.
        safety: Factor on the number of substeps that is just stable.
    """
    step = largest_stable_step(model, parameters, control)
    return max(1, math.ceil(safety / (parameters.simulated_frame_rate * step)))


def explain_divergence(model: SpringMassModel, parameters: SimulationParameters, node: int) -> str:
    """Name the two parameters most likely to blame for a node that blew up, and the remedy."""
    dt = parameters.dt
    spring = np.flatnonzero(np.any(model.spring_nodes == node, axis=1))
    if len(spring) == 0:
        return f"No spring holds it: check initial velocity and gravity ({parameters.gravity})."
    stiffness = parameters.stiffness_scale * model.stiffness[spring]
    rate = stiffness / model.rest_length[spring]
    damping_load = 2.0 * dt * float(model.damping[spring].sum())
    stiffness_load = dt * dt * float(rate.sum())
    worst = spring[np.argmax(rate)]
    prefix = "virtual_" if worst >= model.object_spring_count else ""
    length = float(model.rest_length[worst])
    substeps = f"substeps_per_frame ({parameters.substeps_per_frame})"
    if damping_load > stiffness_load:
        return (
            f"Likely to blame: damping (up to {model.damping[spring].max():.3g} N·s/m) and "
            f"{substeps}. Lower the first or raise the second."
        )
    if float(rate.max()) > 0.5 * float(rate.sum()):
        floor = f"{prefix}rest_length_floor"
        return (
            f"Likely to blame: {floor} (spring {worst} is only {length:.2g} m long) and "
            f"{substeps}. Raise either, or lower {prefix}stiffness."
        )
    return (
        f"Likely to blame: {prefix}stiffness (up to {stiffness.max():.3g} N) and {substeps}. "
        f"Lower the first or raise the second (shortest rest length {length:.2g} m)."
    )


def _critical_step(stiffness: float, damping: float) -> float:
    """Return the dt with dt² k + 2 dt c = 4."""
    if stiffness <= 0.0 and damping <= 0.0:
        return math.inf
    return 4.0 / (damping + math.sqrt(damping * damping + 4.0 * stiffness))


def _stretch_matrix(model: SpringMassModel, control: ndarray | None) -> tuple[csr_array, ndarray]:
    """Map node motion to spring stretch; also return which spring each row belongs to."""
    count = model.node_count
    first, second = model.spring_nodes[: model.object_spring_count].T
    node = model.object_node.astype(np.float64)
    direction = _unit(node[second] - node[first])
    row = np.arange(model.object_spring_count)
    blocks = [(row, second, direction), (row, first, -direction)]
    spring = row
    virtual = np.arange(model.object_spring_count, len(model.spring_nodes))
    ends = model.spring_nodes[virtual]
    held = ends.min(axis=1) if len(ends) else np.zeros(0, dtype=np.int64)
    if control is None:
        for axis in np.eye(3):
            rows = len(spring) + np.arange(len(virtual))
            blocks.append((rows, held, np.broadcast_to(axis, (len(virtual), 3))))
            spring = np.concatenate([spring, virtual])
    else:
        rows = len(spring) + np.arange(len(virtual))
        offset = node[held] - np.asarray(control, dtype=np.float64)[ends.max(axis=1) - count]
        blocks.append((rows, held, _unit(offset)))
        spring = np.concatenate([spring, virtual])
    rows = np.concatenate([np.repeat(rows, 3) for rows, _, _ in blocks])
    columns = np.concatenate(
        [(3 * np.asarray(nodes)[:, None] + np.arange(3)).ravel() for _, nodes, _ in blocks]
    )
    values = np.concatenate([np.ravel(value) for _, _, value in blocks])
    return csr_array((values, (rows, columns)), shape=(len(spring), 3 * count)), spring


def _unit(offset: ndarray) -> ndarray:
    return offset / np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-12)
