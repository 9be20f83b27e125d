"""Strain and force of springs, and the push of hands, in one frame in float64, for drawing."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial.distance import cdist

from physhandi.simulation.kernels.push_constants import (
    FARTHEST_FACE,
    LEAVING_SPEED,
    MOST_ASIDE,
    MOST_DEPTH,
    SAME_DISTANCE,
)
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters


def spring_lengths(
    model: SpringMassModel,
    position: Float[ndarray, "node 3"],
    control: Float[ndarray, "control 3"],
    springs: slice = slice(None),
) -> Float[ndarray, " chosen"]:
    """Measure how long springs are [m].

    Args:
        model: Springs.
        position: Positions of the object nodes [m].
        control: Positions of the control nodes [m].
        springs: Which of them; object springs come first, then virtual ones.
    """
    return np.linalg.norm(_offsets(model.spring_nodes[springs], position, control), axis=1)


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
    return spring_lengths(model, position, control) / model.rest_length - 1.0


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


def push_forces(
    model: SpringMassModel,
    parameters: SimulationParameters,
    state: tuple[ndarray, ndarray, ndarray, ndarray],
    hand: Float[ndarray, "control 3"],
    start: tuple[Float[ndarray, "node 3"], Float[ndarray, "control 3"]],
) -> tuple[Int[ndarray, " node"], Float[ndarray, "node 3"]]:
    """Compute the force with which the surface of the hands pushes each object node.

    The law is that of `kernels.hand_contact`, at the state. How a rope bends is not among the
    forces that friction has to hold.

    Args:
        model: Springs, material, and the triangles of the hands.
        parameters: For `push_stiffness`, `hand_friction`, `gravity` and the substep.
        state: Positions and velocities of the object nodes, then of the control nodes [m, m/s].
        hand: Corners of the triangles: the control nodes where no restart moved them [m].
        start: Object nodes and corners at the start of the frame, which tell the triangle beside
            each node [m].

    Returns:
        Triangle that pushes each node, -1 for none, and forces in the world frame [N].
    """
    face, weight = _faces_beside(model, *(np.asarray(each, np.float64) for each in start))
    force = np.zeros((model.node_count, 3))
    node = np.flatnonzero(face >= 0)
    position, velocity, control, control_velocity = (np.asarray(s, np.float64) for s in state)
    corners = model.hand_face[face[node]]
    first, second, third = np.moveaxis(np.asarray(hand, np.float64)[corners], 1, 0)
    normal = _unit(np.cross(second - first, third - first))
    load = parameters.push_stiffness * -_dot(position[node] - first, normal)
    held_velocity = _control_velocity(parameters, control, control_velocity)
    pull = _spring_sums(model, parameters, (position, velocity, control, held_velocity))[node]
    kick = parameters.dt * (pull - [0.0, 0.0, parameters.gravity])
    slip = velocity[node] + kick - _dot(weight[node, :, None], control_velocity[corners], axis=1)
    leaving = _dot(slip, normal)
    acts = (load > 0.0) & (leaving < LEAVING_SPEED)
    load, room = np.where(acts, load, 0.0), 1.0 - leaving / LEAVING_SPEED
    pressure = load * room / (1.0 + parameters.dt * load / LEAVING_SPEED)
    sliding = slip - leaving[:, None] * normal
    grip = np.minimum(parameters.hand_friction * pressure, _length(sliding) / parameters.dt)
    force[node] = pressure[:, None] * normal - grip[:, None] * _unit(sliding)
    face[node[~acts]] = -1
    return face, force


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


def _faces_beside(
    model: SpringMassModel, position: Float[ndarray, "node 3"], hand: Float[ndarray, "control 3"]
) -> tuple[Int[ndarray, " node"], Float[ndarray, "node 3"]]:
    """Find the triangle beside each node, -1 for none, and the weights of its nearest point."""
    face, weight = np.full(model.node_count, -1), np.zeros((model.node_count, 3))
    virtual = slice(model.object_spring_count, None)
    ends, stiffness = model.spring_nodes[virtual], model.stiffness[virtual]
    held = ends[stiffness > 0.0].min(axis=1, initial=model.node_count)
    node = np.setdiff1d(np.arange(model.node_count), held)
    corner = hand[model.hand_face]
    size = _length(corner - np.roll(corner, 1, axis=1)).max(axis=1)
    # No point of a triangle is farther from a corner than its longest edge.
    gap = cdist(position[node], corner[:, 0])
    may = gap - size < FARTHEST_FACE * size
    least = np.where(may, gap, np.inf).min(axis=1, keepdims=True)
    may &= gap - size <= (1.0 + SAME_DISTANCE) * least
    owner, pair = np.nonzero(may)
    if not len(pair):
        return face, weight
    used, first, owner = np.unique(owner, return_index=True, return_inverse=True)
    node = node[used]
    offset = position[node[owner]] - corner[pair, 0]
    edges = corner[pair, 1:] - corner[pair, :1]
    beside = _nearest_weights(offset, edges[:, 0], edges[:, 1])
    square = ((offset - _dot(beside[:, 1:, None], edges, axis=1)) ** 2).sum(axis=1)
    height = _dot(offset, _unit(np.cross(edges[:, 0], edges[:, 1])))
    nearest = np.minimum.reduceat(square, first)[owner]
    is_nearest = square <= (1.0 + SAME_DISTANCE) * nearest
    # Of those that are equally near, the one whose plane is farthest; of those, the first.
    order = np.lexsort((pair, -np.abs(height), ~is_nearest, owner))
    best = order[first]
    aside = np.sqrt(np.maximum(square[best] - height[best] ** 2, 0.0))
    edge = size[pair[best]]
    is_within = np.sqrt(square[best]) < FARTHEST_FACE * edge
    is_within &= (height[best] > -MOST_DEPTH * edge) & (aside < MOST_ASIDE * edge)
    face[node[is_within]] = pair[best[is_within]]
    weight[node[is_within]] = beside[best[is_within]]
    return face, weight


def _nearest_weights(
    point: Float[ndarray, "pair 3"],
    edge_1: Float[ndarray, "pair 3"],
    edge_2: Float[ndarray, "pair 3"],
) -> Float[ndarray, "pair 3"]:
    """Give the barycentric weights of the point of each triangle that is nearest to a point."""
    a, b, c = _dot(edge_1, edge_1), _dot(edge_1, edge_2), _dot(edge_2, edge_2)
    along_1, along_2 = _dot(edge_1, point), _dot(edge_2, point)
    square = np.maximum(a * c - b * b, 1e-30)
    v, w = (c * along_1 - b * along_2) / square, (a * along_2 - b * along_1) / square
    third, zero = edge_2 - edge_1, np.zeros(len(point))
    on_1, on_2 = along_1 / np.maximum(a, 1e-30), along_2 / np.maximum(c, 1e-30)
    on_3 = _dot(third, point - edge_1) / np.maximum(_dot(third, third), 1e-30)
    on_1, on_2, on_3 = (np.clip(each, 0.0, 1.0) for each in (on_1, on_2, on_3))
    # The point below, if it is inside, or else the nearest of the three edges.
    choices = np.stack([[v, w], [on_1, zero], [zero, on_2], [1.0 - on_3, on_3]])
    gap = [_length(point - v[:, None] * edge_1 - w[:, None] * edge_2) for v, w in choices]
    gap[0] = np.where((v >= 0.0) & (w >= 0.0) & (v + w <= 1.0), -1.0, np.inf)
    v, w = choices[np.argmin(gap, axis=0), :, np.arange(len(point))].T
    return np.stack([1.0 - v - w, v, w], axis=1)


def _spring_sums(
    model: SpringMassModel,
    parameters: SimulationParameters,
    state: tuple[ndarray, ndarray, ndarray, ndarray],
) -> Float[ndarray, "node 3"]:
    """Sum the forces of all springs on each object node [N]."""
    tension, direction = _pull(model, parameters, slice(None), state)
    total = np.zeros((model.node_count + model.control_count, 3))
    for end, sign in zip(np.sort(model.spring_nodes, axis=1).T, (1.0, -1.0), strict=True):
        np.add.at(total, end, sign * tension[:, None] * direction)
    return total[: model.node_count]


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


def _dot(a: ndarray, b: ndarray, axis: int = -1) -> ndarray:
    return (a * b).sum(axis=axis)


def _length(vector: ndarray) -> ndarray:
    return np.linalg.norm(vector, axis=-1)


def _unit(vector: ndarray) -> ndarray:
    return vector / np.maximum(_length(vector), 1e-12)[..., None]
