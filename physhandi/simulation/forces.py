"""How hard the hand pulls: the forces of the virtual springs, drawn as arrows in the viewer."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.simulation.model import SimulationParameters, SpringMassModel


def virtual_spring_forces(  # noqa: PLR0917  (model, then state in the order of the equations)
    model: SpringMassModel,
    parameters: SimulationParameters,
    position: Float[ndarray, "node 3"],
    velocity: Float[ndarray, "node 3"],
    control: Float[ndarray, "control 3"],
    control_velocity: Float[ndarray, "control 3"] | None = None,
) -> Float[ndarray, "virtual 3"]:
    """Compute the force that each virtual spring puts on its object node.

    Follows ``F = [Y (L / r - 1) + c (v_j - v_i)·d] d``.

    Args:
        model: Springs and material.
        parameters: For `stiffness_scale` and `use_control_velocity`.
        position: Positions of the object nodes [m].
        velocity: Velocities of the object nodes [m/s].
        control: Positions of the control nodes [m].
        control_velocity: Velocities of the control nodes [m/s]; at rest if left out, or if
            `use_control_velocity` is off.

    Returns:
        Forces in the world frame [N], virtual springs in the model's order.
    """
    virtual = slice(model.object_spring_count, None)
    ends = np.sort(model.spring_nodes[virtual], axis=1)
    held, holder = ends[:, 0], ends[:, 1] - model.node_count
    offset = np.asarray(control, dtype=np.float64)[holder] - position[held]
    stretch = -np.asarray(velocity, dtype=np.float64)[held]
    if control_velocity is not None and parameters.use_control_velocity:
        stretch = stretch + np.asarray(control_velocity)[holder]
    length = np.linalg.norm(offset, axis=1)
    direction = offset / np.maximum(length, 1e-6)[:, None]
    strain = length / model.rest_length[virtual] - 1.0
    tension = parameters.stiffness_scale * model.stiffness[virtual] * strain
    tension = tension + model.damping[virtual] * np.sum(stretch * direction, axis=1)
    return tension[:, None] * direction


def virtual_forces(  # noqa: PLR0917  (model, then state in the order of the equations)
    model: SpringMassModel,
    parameters: SimulationParameters,
    position: Float[ndarray, "node 3"],
    velocity: Float[ndarray, "node 3"],
    control: Float[ndarray, "control 3"],
    control_velocity: Float[ndarray, "control 3"] | None = None,
) -> Float[ndarray, "node 3"]:
    """Sum the forces that virtual springs put on each object node.

    The arguments are those of `virtual_spring_forces`; object springs, gravity, drag and contact
    are not included.

    Returns:
        Force on each object node in the world frame [N]; zero for a node that nothing holds.
    """
    pull = virtual_spring_forces(model, parameters, position, velocity, control, control_velocity)
    held = model.spring_nodes[model.object_spring_count :].min(axis=1, initial=model.node_count)
    return np.stack(
        [np.bincount(held, weights=pull[:, axis], minlength=model.node_count) for axis in range(3)],
        axis=1,
    )
