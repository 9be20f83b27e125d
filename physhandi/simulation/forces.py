"""Strain and force of springs in one frame, in float64, for drawing and coloring."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters


def spring_strains(
    model: SpringMassModel,
    position: Float[ndarray, "node 3"],
    control: Float[ndarray, "control 3"],
) -> Float[ndarray, " spring"]:
    """Compute the strain of each spring, ``L / r - 1``; negative if it is shorter than at rest.

    Args:
        model: Springs.
        position: Positions of the object nodes [m].
        control: Positions of the control nodes [m].

    Returns:
        Strains, object springs and then virtual ones in the model's order.
    """
    offset = _offsets(model.spring_nodes, position, control)
    return np.linalg.norm(offset, axis=1) / model.rest_length - 1.0


def spring_tensions(  # noqa: PLR0917  (model, then state in the order of the equations)
    model: SpringMassModel,
    parameters: SimulationParameters,
    position: Float[ndarray, "node 3"],
    velocity: Float[ndarray, "node 3"],
    control: Float[ndarray, "control 3"],
    control_velocity: Float[ndarray, "control 3"] | None = None,
) -> Float[ndarray, " spring"]:
    """Compute the tension of each spring [N]; negative under compression.

    Follows ``T = Y (L / r - 1) + c (v_j - v_i)·d``, which is `Y` times strain plus the dashpot.

    Args:
        model: Springs and material.
        parameters: For `stiffness_scale` and `use_control_velocity`.
        position: Positions of the object nodes [m].
        velocity: Velocities of the object nodes [m/s].
        control: Positions of the control nodes [m].
        control_velocity: Velocities of the control nodes [m/s]; at rest if left out, or if
            `use_control_velocity` is off.

    Returns:
        Tensions, object springs and then virtual ones in the model's order.
    """
    moved = _control_velocity(parameters, control, control_velocity)
    return _pull(model, parameters, slice(None), (position, velocity, control, moved))[0]


def virtual_spring_forces(  # noqa: PLR0917  (model, then state in the order of the equations)
    model: SpringMassModel,
    parameters: SimulationParameters,
    position: Float[ndarray, "node 3"],
    velocity: Float[ndarray, "node 3"],
    control: Float[ndarray, "control 3"],
    control_velocity: Float[ndarray, "control 3"] | None = None,
) -> Float[ndarray, "virtual 3"]:
    """Compute the force of each virtual spring on its object node.

    Follows ``F = [Y (L / r - 1) + c (v_j - v_i)·d] d``; the arguments are those of
    `spring_tensions`.

    Returns:
        Forces in the world frame [N], virtual springs in the model's order.
    """
    virtual = slice(model.object_spring_count, None)
    moved = _control_velocity(parameters, control, control_velocity)
    tension, direction = _pull(model, parameters, virtual, (position, velocity, control, moved))
    return tension[:, None] * direction


def virtual_forces(  # noqa: PLR0917  (model, then state in the order of the equations)
    model: SpringMassModel,
    parameters: SimulationParameters,
    position: Float[ndarray, "node 3"],
    velocity: Float[ndarray, "node 3"],
    control: Float[ndarray, "control 3"],
    control_velocity: Float[ndarray, "control 3"] | None = None,
) -> Float[ndarray, "node 3"]:
    """Sum the forces of virtual springs on each object node.

    The arguments are those of `spring_tensions`; object springs, gravity, drag and contact
    are not included.

    Returns:
        Force on each object node in the world frame [N]; zero for a node that nothing holds.
    """
    pull = virtual_spring_forces(model, parameters, position, velocity, control, control_velocity)
    held_node = model.spring_nodes[model.object_spring_count :].min(
        axis=1, initial=model.node_count
    )
    return np.stack(
        [
            np.bincount(held_node, weights=pull[:, axis], minlength=model.node_count)
            for axis in range(3)
        ],
        axis=1,
    )


def node_means(model: SpringMassModel, value: Float[ndarray, " spring"]) -> Float[ndarray, " node"]:
    """Average a value of the object springs over those that end at each object node.

    Args:
        model: Springs.
        value: One number a spring; those of virtual springs are not used.

    Returns:
        Means; NaN for a node without object springs.
    """
    ends = model.spring_nodes[: model.object_spring_count]
    weights = np.repeat(np.asarray(value[: len(ends)], dtype=np.float64), 2)
    total = np.bincount(ends.ravel(), weights=weights, minlength=model.node_count)
    count = np.bincount(ends.ravel(), minlength=model.node_count)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _control_velocity(
    parameters: SimulationParameters,
    control: Float[ndarray, "control 3"],
    control_velocity: Float[ndarray, "control 3"] | None,
) -> Float[ndarray, "control 3"]:
    """Get the control nodes' velocity as the simulator uses it [m/s]."""
    if control_velocity is None or not parameters.use_control_velocity:
        return np.zeros_like(control, dtype=np.float64)
    return np.asarray(control_velocity, dtype=np.float64)


def _pull(
    model: SpringMassModel,
    parameters: SimulationParameters,
    springs: slice,
    state: tuple[ndarray, ndarray, ndarray, ndarray],
) -> tuple[Float[ndarray, " spring"], Float[ndarray, "spring 3"]]:
    """Compute tension, and the direction from the end with the smaller number to the other."""
    position, velocity, control, control_velocity = state
    ends = np.sort(model.spring_nodes[springs], axis=1)
    offset = _offsets(ends, position, control)
    stretch = _offsets(ends, velocity, control_velocity)
    length = np.linalg.norm(offset, axis=1)
    direction = offset / np.maximum(length, 1e-6)[:, None]
    strain = length / model.rest_length[springs] - 1.0
    tension = parameters.stiffness_scale * model.stiffness[springs] * strain
    return tension + model.damping[springs] * np.sum(stretch * direction, axis=1), direction


def _offsets(
    ends: Int[ndarray, "spring 2"],
    node: Float[ndarray, "node 3"],
    control: Float[ndarray, "control 3"],
) -> Float[ndarray, "spring 3"]:
    """Subtract what belongs to the first end of each spring from what belongs to the second."""
    value = np.concatenate([np.asarray(node, np.float64), np.asarray(control, np.float64)])
    return value[ends[:, 1]] - value[ends[:, 0]]
