"""The longest stable substep of a model, and automatic substeps."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.linalg import eigh_tridiagonal
from scipy.sparse import csr_array, vstack

from physhandi.rotations import unit
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.rod import Rod

SAFETY = 1.25
"""Factor on the number of substeps that is just stable, for motion away from frame 0."""
LONGEST_STEP = 1.0 / 3600.0
"""Longest substep that automatic substeps take, however soft the springs are [s]: what keeps the
bundled towel within 1 mm of the reference on average in every frame (docs/benchmarks)."""
_LANCZOS_STEPS = 20
_STEP_TOLERANCE = 1e-3
_MOST_ROUNDS = 8


def largest_stable_step(
    model: SpringMassModel,
    parameters: SimulationParameters,
    control: Float[ndarray, "control 3"] | None = None,
) -> float:
    """Estimate the longest substep for which semi-implicit Euler is stable [s].

    A mode with stiffness k and damping c (unit mass) is stable if ``dt² k + 2 dt c < 4``. For a
    guess of dt, Lanczos iterations find the mode of all springs at frame 0 for which the left
    side is largest; the dt at which it reaches 4 is the next guess. Hands that push may push every
    node; other contact, drag and large rotations are not included.

    What is found is never below the true limit, so `stable_substeps` adds a margin. Each guess
    takes 20 products with the operator; from a random start those miss the largest
    eigenvalue of 3,000 nodes by 12 % on average for the worst of all operators (Kuczyński and
    Woźniakowski, SIAM J. Matrix Anal. Appl. 13, 1992, theorem 3.2), of real springs by 0.1 %.

    Args:
        model: Springs and material.
        parameters: For `stiffness_scale`.
        control: Where the control nodes are at frame 0 [m]. Left out, each virtual spring is
            taken to act in all directions, which errs on the safe side; one that is attached
            later always is.

    Returns:
        The step; infinity if nothing is stiff or damped.
    """
    springs = _SpringOperator.of(model, parameters, control)
    step = critical_step(springs.highest_load("stiffness"), springs.highest_load("damping"))
    if math.isinf(step):
        return step
    mode = np.random.default_rng(0).standard_normal(3 * model.node_count)
    for _ in range(_MOST_ROUNDS):
        mode = _stiffest_mode(springs, step, mode)
        previous, step = step, critical_step(*springs.of_mode(mode))
        if abs(step - previous) <= _STEP_TOLERANCE * step:
            break
    return step


def stable_substeps(
    model: SpringMassModel,
    parameters: SimulationParameters,
    control: Float[ndarray, "control 3"] | None = None,
    *,
    safety: float = SAFETY,
) -> int:
    """Return how many substeps a frame needs, with a margin for motion away from frame 0.

    Args:
        model: Springs and material.
        parameters: For `simulated_frame_rate` and `stiffness_scale`.
        control: Where the control nodes are at frame 0 [m]; see `largest_stable_step`.
        safety: Factor on the number of substeps that is just stable.
    """
    return substeps_of(largest_stable_step(model, parameters, control), parameters, safety)


def substeps_of(step: float, parameters: SimulationParameters, safety: float) -> int:
    """Return how many substeps a frame needs, of which none is longer than the longest stable one.

    Args:
        step: Longest stable substep [s].
        parameters: For `simulated_frame_rate`.
        safety: Factor on the number of substeps that is just stable.
    """
    return max(1, math.ceil(safety / (parameters.simulated_frame_rate * step)))


def with_stable_substeps(
    parameters: SimulationParameters,
    model: SpringMassModel,
    control: Float[ndarray, "control 3"] | None = None,
    *,
    safety: float = SAFETY,
    longest_step: float = LONGEST_STEP,
) -> SimulationParameters:
    """Choose as few substeps as are stable and not visibly coarser than the reference of 667.

    Args:
        parameters: What else to simulate with; the frame rate must be the sequence's.
        model: Springs and material.
        control: Where the control nodes are at frame 0 [m]; see `largest_stable_step`.
        safety: Factor on the number of substeps that is just stable.
        longest_step: No substep is longer than this [s]; infinity for stability alone.

    Returns:
        The parameters with another `substeps_per_frame`.
    """
    stable = stable_substeps(model, parameters, control, safety=safety)
    # A frame that is a whole number of longest steps must not get one more by rounding.
    fine = math.ceil(1.0 / (parameters.simulated_frame_rate * longest_step) - 1e-6)
    return parameters.replace(substeps_per_frame=max(stable, fine))


def explain_divergence(model: SpringMassModel, parameters: SimulationParameters, node: int) -> str:
    """Name the two most likely causes of a node's divergence, and the remedy."""
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


def critical_step(stiffness: float, damping: float) -> float:
    """Return the longest stable substep of a mode of unit mass, the dt with dt² k + 2 dt c = 4 [s].

    Args:
        stiffness: The k [N/m].
        damping: The c [N·s/m].
    """
    if stiffness <= 0.0 and damping <= 0.0:
        return math.inf
    return 4.0 / (damping + math.sqrt(damping * damping + 4.0 * stiffness))


@dataclass(frozen=True)
class _SpringOperator:
    """Stiffness and damping of all springs, applied to motions of the object nodes."""

    stretch: csr_array
    """Maps node motion to the stretch of each spring whose direction is known."""
    rate: dict[str, ndarray]
    """Stiffness [N/m] and damping [N·s/m] of those springs."""
    anchor: dict[str, ndarray]
    """Contribution of springs of unknown direction to each coordinate."""

    @classmethod
    def of(
        cls, model: SpringMassModel, parameters: SimulationParameters, control: ndarray | None
    ) -> "_SpringOperator":
        own, count = model.object_spring_count, model.node_count
        stiffness = model.stiffness.astype(np.float64) / model.rest_length
        rate = {
            "stiffness": parameters.stiffness_scale * stiffness,
            "damping": model.damping.astype(np.float64),
        }
        node = model.object_node.astype(np.float64)
        ends, virtual = model.spring_nodes[:own], model.spring_nodes[own:]
        held_node = virtual.min(axis=1, initial=count)
        direction = unit(node[ends[:, 1]] - node[ends[:, 0]])
        value = np.concatenate([-direction, direction], axis=1).ravel()
        column = _coordinates(ends)
        row_end = 6 * np.arange(own + 1)
        if control is None:
            anchor = {
                name: np.repeat(np.bincount(held_node, value[own:], minlength=count), 3)
                for name, value in rate.items()
            }
            rate = {name: value[:own] for name, value in rate.items()}
        else:
            place = np.asarray(control, dtype=np.float64)[virtual.max(axis=1, initial=0) - count]
            value = np.concatenate([value, unit(node[held_node] - place).ravel()])
            column = np.concatenate([column, _coordinates(held_node)])
            row_end = np.concatenate([row_end, row_end[-1] + 3 * np.arange(1, len(held_node) + 1)])
            # Where a spring that is attached later points then is not known.
            late = own + np.flatnonzero(model.attached[:, 0] > 0)
            anchor = {
                name: np.repeat(np.bincount(held_node[late - own], each[late], minlength=count), 3)
                for name, each in rate.items()
            }
            for each in rate.values():
                each[late] = 0.0
        if parameters.hand_pushes and len(model.hand_face):
            # A node is pushed by one triangle at a time, in whichever direction; what that
            # dissipates is implicit.
            pushed = anchor["stiffness"] + parameters.push_stiffness
            anchor = {"stiffness": pushed, "damping": anchor["damping"]}
        shape = (len(row_end) - 1, 3 * count)
        stretch = csr_array((value, column, row_end), shape=shape)
        if model.rod is not None:
            bends, load = _bends(model.rod, node), model.rod.stiffness / model.rod.length[1:-1]
            stretch = csr_array(vstack([stretch, bends]))
            scale = {"stiffness": parameters.stiffness_scale, "damping": model.rod.damping}
            for name, own_rate in rate.items():
                rate[name] = np.concatenate([own_rate, np.repeat(scale[name] * load, 3)])
        return cls(stretch, rate, anchor)

    def of_mode(self, mode: ndarray) -> tuple[float, float]:
        """Return stiffness and damping of a mode of length 1."""
        squared, own = np.square(self.stretch @ mode), np.square(mode)
        values = (
            _dot(squared, self.rate[name]) + _dot(own, self.anchor[name])
            for name in ("stiffness", "damping")
        )
        return next(values), next(values)

    def highest_load(self, name: str) -> float:
        """Return the largest sum at one coordinate: the scale of the highest eigenvalue."""
        return float(np.max(abs(self.stretch).T @ self.rate[name] + self.anchor[name], initial=0.0))


def _bends(rod: Rod, node: Float[ndarray, "node 3"]) -> csr_array:
    """Map node motion to the change of direction at each vertex of a rope, in all directions.

    That along the rope is no bending, but springs are stiffer there anyway.
    """
    step = np.linalg.norm(np.diff(node[rod.node], axis=0), axis=1)
    before, behind = 1.0 / step[:-1], 1.0 / step[1:]
    value = np.stack([before, -before - behind, behind], axis=1)
    column = _coordinates(np.stack([rod.node[:-2], rod.node[1:-1], rod.node[2:]], axis=1))
    column = column.reshape(-1, 3, 3).swapaxes(1, 2)
    rows = 3 * len(value)
    entries = np.repeat(value, 3, axis=0).ravel(), column.ravel(), 3 * np.arange(rows + 1)
    return csr_array(entries, shape=(rows, 3 * len(node)))


def _stiffest_mode(springs: _SpringOperator, step: float, start: ndarray) -> ndarray:
    """Find the mode for which dt K + 2 C is largest, by Lanczos from a start.

    SciPy's `eigsh` needs as many products, but waits for the threads of a BLAS at each.
    """
    weight, anchor = (
        step * part["stiffness"] + 2.0 * part["damping"] for part in (springs.rate, springs.anchor)
    )
    pull = springs.stretch.T
    basis = [start / _length(start)]
    diagonal: list[float] = []
    beside: list[float] = []
    for count in range(1, min(_LANCZOS_STEPS, len(start)) + 1):
        motion = basis[-1]
        force = pull @ (weight * (springs.stretch @ motion)) + anchor * motion
        diagonal.append(_dot(motion, force))
        force -= diagonal[-1] * motion
        if beside:
            force -= beside[-1] * basis[-2]
        rest = _length(force)
        # Springs of few nodes have no more modes than this.
        if count == _LANCZOS_STEPS or rest <= 1e-12 * max(diagonal):
            break
        beside.append(rest)
        basis.append(force / rest)
    last = len(diagonal) - 1
    chosen = {"select": "i", "select_range": (last, last)}
    solution: Any = eigh_tridiagonal(diagonal, beside[:last], **chosen)
    part = solution[1]
    mode = np.zeros(len(start))
    for index in range(last + 1):
        mode += part[index, 0] * basis[index]
    return mode / _length(mode)


def _dot(first: ndarray, second: ndarray) -> float:
    # Unlike `@`, never wakes the threads of a BLAS, which costs milliseconds on busy cores.
    return float(np.einsum("i,i->", first, second))


def _length(value: ndarray) -> float:
    return math.sqrt(_dot(value, value))


def _coordinates(node: ndarray) -> ndarray:
    """Return where the three coordinates of nodes are in a flat motion."""
    return (3 * node[..., None] + np.arange(3)).ravel()
