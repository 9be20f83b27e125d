"""Builds springs from connection radius δ and neighbor limit d_max on frame 0."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int32
from numpy import ndarray
from scipy.spatial import KDTree

from physhandi.simulation.contact_intervals import ContactIntervals, always
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.rod import Rod
from physhandi.unique_rows import unique_rows

MINIMUM_LENGTH = 1e-4
"""Object nodes that are no farther apart than this are not joined [m]."""
MINIMUM_VIRTUAL_REST_LENGTH = 1e-6
"""Floor for control nodes on top of object nodes, against division by zero [m]."""

SAME_LENGTH = 1e-5
"""Rest lengths whose ratio differs from 1 by less than this are the same."""

SpringList = tuple[Int32[ndarray, "spring 2"], Float[ndarray, " spring"]]


def object_springs(
    node: Float[ndarray, "node 3"], connection_radius: float, max_neighbors: int
) -> SpringList:
    """Join object nodes that are near to each other.

    Each node proposes springs to its `max_neighbors` nearest other nodes, as far as they are
    strictly nearer than `connection_radius`. The springs are the union of all proposals, so
    a node can have more springs than it proposed. Pairs not farther apart than
    `MINIMUM_LENGTH` are left out.

    Args:
        node: Positions of the object nodes at rest [m].
        connection_radius: δ [m].
        max_neighbors: d_max; the node itself is not counted.

    Returns:
        The springs as (lower node, higher node) in ascending order, and their lengths [m].
    """
    node_count = len(node)
    if max_neighbors < 1 or node_count < 2:
        return _no_springs()
    neighbor_count = min(max_neighbors + 1, node_count)
    distance, neighbor = (
        np.asarray(columns) for columns in KDTree(node).query(node, k=neighbor_count)
    )
    own = np.arange(node_count)[:, None]
    is_other = neighbor != own
    # Of duplicated positions the node itself may rank behind its twins, or fall out.
    is_kept = is_other & (np.cumsum(is_other, axis=1) <= max_neighbors)
    is_kept &= (distance < connection_radius) & (distance > MINIMUM_LENGTH)
    first = np.broadcast_to(own, neighbor.shape)[is_kept]
    second = neighbor[is_kept]
    pair = np.stack([np.minimum(first, second), np.maximum(first, second)], axis=1)
    springs = unique_rows(pair)[0].astype(np.int32)
    return springs, np.linalg.norm(node[springs[:, 1]] - node[springs[:, 0]], axis=1)


def chain_springs(node: Float[ndarray, "node 3"], order: Int32[ndarray, " vertex"]) -> SpringList:
    """Join the nodes of a rope to their neighbors along it; see `object_springs`."""
    springs = np.sort(np.stack([order[:-1], order[1:]], axis=1), axis=1)
    springs = springs[np.lexsort(springs.T[::-1])].astype(np.int32)
    return springs, np.linalg.norm(node[springs[:, 1]] - node[springs[:, 0]], axis=1)


def virtual_springs(
    control: Float[ndarray, "control 3"],
    node: Float[ndarray, "node 3"],
    radius: float,
    max_neighbors: int,
) -> SpringList:
    """Join each control node to the object nodes near it.

    Args:
        control: Positions of the control nodes at frame 0 [m].
        node: Positions of the object nodes at frame 0 [m].
        radius: Object nodes strictly nearer than this are joined [m].
        max_neighbors: Most springs of one control node.

    Returns:
        The springs as (object node, `len(node)` + control) in ascending order, and their
        lengths [m].
    """
    if max_neighbors < 1 or len(node) == 0 or len(control) == 0:
        return _no_springs()
    count = min(max_neighbors, len(node))
    distance, neighbor = (
        np.reshape(columns, (len(control), count))
        for columns in KDTree(node).query(control, k=count)
    )
    is_kept = distance < radius
    control_index = np.broadcast_to(np.arange(len(control))[:, None], neighbor.shape)[is_kept]
    object_index = neighbor[is_kept]
    order = np.lexsort((control_index, object_index))
    springs = np.stack([object_index, len(node) + control_index], axis=1)[order]
    return springs.astype(np.int32), distance[is_kept][order]


def virtual_floor(parameters: SimulationParameters) -> float:
    """Give the shortest rest length that a virtual spring may have [m]."""
    return max(parameters.virtual_rest_length_floor, MINIMUM_VIRTUAL_REST_LENGTH)


def build_model(  # noqa: PLR0917  (nodes, what holds them, then what is known of the object)
    object_node: Float[ndarray, "node 3"],
    control_0: Float[ndarray, "control 3"],
    parameters: SimulationParameters,
    rest_node: Float[ndarray, "node 3"] | None = None,
    contacts: ContactIntervals | None = None,
    rod: Rod | None = None,
) -> SpringMassModel:
    """Build the springs of an object and of the control nodes that touch it.

    Args:
        object_node: Positions of the object nodes at frame 0 [m].
        control_0: Positions of the control nodes at frame 0 [m]; may be empty.
        parameters: Radii, neighbor limits, rest length floors, stiffness and damping.
        rest_node: The object's rest shape [m], if it differs from frame 0; it decides the
            object springs and their rest lengths.
        contacts: Pairs that are joined for an interval of frames; if left out, control nodes are
            joined for all frames to what is near them at frame 0.
        rod: How the object bends, if it is a rope: then springs join neighbors along it, whatever
            the radius.

    Returns:
        The model, at rest. A spring without stiffness is off, its dashpot included (physics.md
        §3.1). `stiffness_scale` is not applied: the simulator does that.
    """
    rest = np.asarray(object_node if rest_node is None else rest_node, dtype=np.float64)
    if rest.shape != object_node.shape:
        raise ValueError(f"rest_node has shape {rest.shape}; expected {object_node.shape}.")
    node = np.asarray(object_node, dtype=np.float64)
    if rod is None:
        reach = parameters.connection_radius, parameters.max_neighbors
        springs, length = object_springs(rest, *reach)
    else:
        springs, length = chain_springs(rest, rod.node)
    reach = parameters.virtual_connection_radius, parameters.virtual_max_neighbors
    if contacts is None:
        virtual, virtual_length = virtual_springs(
            np.asarray(control_0, dtype=np.float64), node, *reach
        )
        attached = always(len(virtual))
    else:
        near = contacts.within(*reach)
        virtual, virtual_length = near.spring_nodes(len(node)), near.distance.astype(np.float64)
        attached = near.interval
    rest_length = np.concatenate(
        [
            np.maximum(length, parameters.rest_length_floor),
            np.maximum(virtual_length, virtual_floor(parameters)),
        ]
    )
    stiffness = np.repeat(
        [parameters.stiffness, parameters.virtual_stiffness], [len(springs), len(virtual)]
    )
    return SpringMassModel(
        object_node=node.astype(np.float32),
        initial_velocity=np.zeros(node.shape, dtype=np.float32),
        spring_nodes=np.concatenate([springs, virtual]),
        rest_length=rest_length.astype(np.float32),
        stiffness=stiffness.astype(np.float32),
        damping=np.where(stiffness > 0.0, parameters.damping, 0.0).astype(np.float32),
        object_spring_count=len(springs),
        control_count=len(control_0),
        attached=attached,
        rod=rod,
    )


def retopologize(
    model: SpringMassModel,
    parameters: SimulationParameters,
    control_0: Float[ndarray, "control 3"],
    *,
    fitted: SimulationParameters,
    rest_node: Float[ndarray, "node 3"] | None = None,
    contacts: ContactIntervals | None = None,
) -> SpringMassModel:
    """Rebuild the springs for other radii or neighbor limits, keeping fitted values.

    A spring that both topologies have keeps the ratio of its stiffness and damping to the
    global value under which it was fitted; a new spring gets the global value. An object spring
    that was given another rest length than its own in the rest shape keeps that ratio too.

    Args:
        model: The fitted model; not modified.
        parameters: The new parameters.
        control_0: Positions of the control nodes at frame 0 [m].
        fitted: The parameters whose global stiffness and damping the fitted values refer to.
        rest_node: The object's rest shape [m]; the nodes of frame 0 if left out.
        contacts: What touches, and when; see `build_model`.

    Returns:
        The new model, with the initial velocity, the clearance and the hands of the old one.
    """
    built = build_model(model.object_node, control_0, parameters, rest_node, contacts, model.rod)
    key, fitted_key = _spring_keys(built), _spring_keys(model)
    _, index, fitted_index = np.intersect1d(key, fitted_key, return_indices=True)
    is_object = fitted_index < model.object_spring_count
    global_stiffness = np.where(is_object, fitted.stiffness, fitted.virtual_stiffness)
    stiffness = built.stiffness.copy()
    damping = built.damping.copy()
    stiffness[index] *= _ratio(model.stiffness[fitted_index], global_stiffness)
    damping[index] *= _ratio(model.damping[fitted_index], np.full(len(index), fitted.damping))
    rest_length = built.rest_length.copy()
    own = index[is_object]
    rest_length[own] *= _rest_ratio(model, fitted, rest_node)[fitted_index[is_object]]
    return replace(
        built,
        rest_length=rest_length,
        stiffness=stiffness,
        damping=damping,
        initial_velocity=model.initial_velocity,
        clearance=model.clearance,
        hand_face=model.hand_face,
    )


def half_edges(
    spring_nodes: Int32[ndarray, "spring 2"], count: int
) -> tuple[Int32[ndarray, " row"], Int32[ndarray, " half_edge"]]:
    """List the springs of every node, so that forces are summed in a fixed order.

    Args:
        spring_nodes: The two nodes of each spring.
        count: Number of nodes, control nodes included.

    Returns:
        Where each node's entries start (`count` + 1 numbers), and the entries: spring `s` is
        `s` at its first node and `-s - 1` at its second.
    """
    spring = np.arange(len(spring_nodes), dtype=np.int32)
    node = np.concatenate([spring_nodes[:, 1], spring_nodes[:, 0]])
    entry = np.concatenate([-spring - 1, spring])[np.argsort(node, kind="stable")]
    start = np.concatenate([[0], np.cumsum(np.bincount(node, minlength=count))])
    return start.astype(np.int32), entry.astype(np.int32)


def split_rows(
    start: Int32[ndarray, " row"], longest: int
) -> tuple[Int32[ndarray, " split"], Int32[ndarray, " row"]]:
    """Cut each node's entries into short rows, so that many threads can sum one node.

    Args:
        start: Where each node's entries start, as `half_edges` returns it.
        longest: Most entries in a row.

    Returns:
        Where each row starts, and which row is the first of each node; both with the end.
    """
    degree = np.diff(start)
    count = -(-degree // longest)
    first = np.concatenate([[0], np.cumsum(count)])
    place = np.arange(first[-1]) - np.repeat(first[:-1], count)
    row = np.repeat(start[:-1], count) + longest * place
    return np.append(row, start[-1]).astype(np.int32), first.astype(np.int32)


def _no_springs() -> SpringList:
    return np.zeros((0, 2), dtype=np.int32), np.zeros(0)


def _rest_ratio(
    model: SpringMassModel, fitted: SimulationParameters, rest_node: ndarray | None
) -> Float[ndarray, " own"]:
    """Compare the object springs' rest lengths with those that they were laid with."""
    rest = np.asarray(model.object_node if rest_node is None else rest_node, dtype=np.float64)
    ends = model.spring_nodes[: model.object_spring_count]
    length = np.linalg.norm(rest[ends[:, 1]] - rest[ends[:, 0]], axis=1)
    laid = np.maximum(length, fitted.rest_length_floor)
    ratio = model.rest_length[: len(ends)] / laid
    # What only rounding changed keeps its bits.
    return np.where(np.abs(ratio - 1.0) > SAME_LENGTH, ratio, 1.0).astype(np.float32)


def _spring_keys(model: SpringMassModel) -> ndarray:
    """Return one number for each unordered pair of nodes and the frame that it is joined in."""
    pair = np.sort(model.spring_nodes.astype(np.int64), axis=1)
    count = model.node_count
    key = pair[:, 0] + pair[:, 1] * count
    key[model.object_spring_count :] += (
        model.attached[:, 0].astype(np.int64) * count * (count + model.control_count)
    )
    return key


def _ratio(value: ndarray, reference: ndarray) -> ndarray:
    """Return value / reference, and 1 where the reference is 0."""
    return np.divide(value, reference, out=np.ones(len(value)), where=reference > 0.0)
