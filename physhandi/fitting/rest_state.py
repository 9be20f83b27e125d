"""The object at rest in frame 0: where its nodes touch the ground, and springs that hold it still.

Nodes are points of the surface that cameras see, mostly the upper one. What lies on the ground
keeps them above it by its thickness, and there they stay: each node that rests at frame 0 has the
height at which it was seen as its *clearance*, the height at which it touches the ground. And what
is seen at frame 0 is the object under its weight, so springs that were at rest there would sag.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32, Int
from numpy import ndarray
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu
from scipy.spatial import KDTree

from physhandi.data.sequence_meta import ShapeClass
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.topology import MINIMUM_LENGTH, MINIMUM_VIRTUAL_REST_LENGTH, virtual_floor

NEAR_GROUND = 1.25
"""Height below which the lowest node of its column rests on the ground, in distances of nodes."""
COLUMN_RADIUS = 0.75
"""Horizontal distance of nodes that stand one above the other, in distances of nodes."""
COLUMN_STEP = 0.25
"""Least difference of their heights, in distances of nodes."""
MOST_CHANGE = 0.05
"""Most by which a rest length changes, as a part of it."""
TOUCH = 1e-4
"""A node that is no higher than this above where it touches the ground is pushed by it [m]."""
EASE_OF_GROUND = 1e3
"""Ease of the ground's push, in terms of the stiffest springs."""
SHARES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
"""How dear uncarried load is: the first with which no rest length changes too much counts."""
MOST_ROUNDS = 8
"""Rounds in which nodes that the ground would have to pull at are found to hang."""


def resting_clearance(
    node: Float[ndarray, "node 3"],
    ground_height: float | None,
    kind: ShapeClass,
    *,
    thickness: float = 0.0,
) -> Float32[ndarray, " node"]:
    """Find the height above the ground at which each node touches it [m].

    A node rests if it is near the ground and the lowest of its column; its clearance is its own
    height. Other nodes of a sheet or a rope come to lie as high as those that rest (the median of
    them), or as they were seen if that is lower: the ground would throw up what begins below its
    clearance. Others of a solid or a shell touch the ground themselves.

    Args:
        node: Object nodes at frame 0 [m].
        ground_height: Height of the ground; None without ground [m].
        kind: Kind of object.
        thickness: Of a rope [m]; others lie within about a node's distance of the ground.

    Returns:
        Clearances; all 0 where nothing rests on the ground.
    """
    clearance = np.zeros(len(node), np.float32)
    if ground_height is None or len(node) < 2:
        return clearance
    point = np.asarray(node, dtype=np.float64)
    spacing = node_distance(point)
    height = np.maximum(point[:, 2] - ground_height, 0.0)
    reach = NEAR_GROUND * max(spacing, thickness if kind == "rope" else 0.0)
    is_resting = (height < reach) & _is_lowest(point, spacing)
    if not is_resting.any():
        return clearance
    if kind in {"sheet", "rope"}:
        clearance[:] = np.minimum(height, np.median(height[is_resting]))
    clearance[is_resting] = height[is_resting]
    return clearance


def node_distance(node: Float[ndarray, "node 3"]) -> float:
    """Return the median distance from a node to the one nearest to it [m]."""
    return float(np.median(KDTree(node).query(node, k=2)[0][:, 1]))


def _is_lowest(node: ndarray, spacing: float) -> ndarray:
    """Mark the nodes below which no other one stands."""
    flat, height = node[:, :2], node[:, 2]
    pairs = KDTree(flat).query_pairs(COLUMN_RADIUS * spacing, output_type="ndarray")
    step = height[pairs[:, 1]] - height[pairs[:, 0]]
    upper = np.where(step > 0.0, pairs[:, 1], pairs[:, 0])[np.abs(step) > COLUMN_STEP * spacing]
    lowest = np.ones(len(node), dtype=bool)
    lowest[upper] = False
    return lowest


def hold_still(
    model: SpringMassModel,
    control_0: Float[ndarray, "control 3"],
    parameters: SimulationParameters,
    *,
    keeps_object: bool = False,
) -> SpringMassModel:
    """Change rest lengths so that the springs carry the object at frame 0, as it was seen.

    Of the forces that balance the weight of every node, the ground's push at those that touch it
    included, it takes those with the least change of strain. No rest length changes by more than
    `MOST_CHANGE`: where that is not enough, as in a cloth that hangs in the air, less of the weight
    is carried everywhere, and it sags. Springs that are shorter than their floor stay as they are.

    Args:
        model: Springs of which most are as long as at rest.
        control_0: Control nodes at frame 0 [m].
        parameters: Gravity, ground, floors of rest lengths and `stiffness_scale`.
        keeps_object: Change the virtual springs only.
    """
    place = np.concatenate([model.object_node, control_0]).astype(np.float64)
    offset = place[model.spring_nodes[:, 1]] - place[model.spring_nodes[:, 0]]
    length = np.linalg.norm(offset, axis=1)
    rest = model.rest_length.astype(np.float64)
    stiffness = parameters.stiffness_scale * model.held_in(0).stiffness.astype(np.float64)
    is_virtual = np.arange(len(rest)) >= model.object_spring_count
    floor = np.where(
        is_virtual,
        virtual_floor(parameters),
        parameters.rest_length_floor,
    )
    acts = (stiffness > 0.0) & (length > np.maximum(floor, MINIMUM_LENGTH))
    if not acts.any():
        return model
    tension = np.where(acts, stiffness * (length / rest - 1.0), 0.0)
    shortest = np.maximum((1.0 - MOST_CHANGE) * rest, floor)
    low = stiffness * (length / ((1.0 + MOST_CHANGE) * rest) - 1.0)
    high = stiffness * (length / np.maximum(shortest, MINIMUM_VIRTUAL_REST_LENGTH) - 1.0)
    may_change = acts & (is_virtual | (not keeps_object))

    ease = np.where(may_change, stiffness, 0.0)
    if not ease.any():
        return model
    direction = offset / np.maximum(length, MINIMUM_LENGTH)[:, None]
    pulls, touching = _pulls(model, direction), _touching(model, parameters)
    weight = np.zeros((model.node_count, 3))
    weight[:, 2] = parameters.gravity
    for share in SHARES:
        force = _balance((pulls, touching), weight.ravel(), tension, ease, share)
        if np.all(~may_change | ((low <= force) & (force <= high))):
            break
    else:
        return model
    strain = np.divide(force, stiffness, out=np.zeros_like(force), where=acts)
    held = np.where(may_change, length / (1.0 + strain), rest)
    return replace(model, rest_length=held.astype(np.float32))


def rest_in_place(model: SpringMassModel, parameters: SimulationParameters) -> SpringMassModel:
    """Make the lengths of object springs at frame 0 their rest lengths, above their floor."""
    own = model.spring_nodes[: model.object_spring_count]
    offset = model.object_node[own[:, 1]] - model.object_node[own[:, 0]]
    length = np.linalg.norm(offset.astype(np.float64), axis=1)
    rest_length = model.rest_length.copy()
    rest_length[: len(own)] = np.maximum(length, max(parameters.rest_length_floor, MINIMUM_LENGTH))
    return replace(model, rest_length=rest_length)


def _touching(model: SpringMassModel, parameters: SimulationParameters) -> Int[ndarray, " resting"]:
    """Find the nodes that the ground can push at."""
    if parameters.ground_height is None:
        return np.zeros(0, dtype=np.int64)
    height = model.object_node[:, 2] - model.clearance - parameters.ground_height
    return np.flatnonzero(height < TOUCH)


def _pulls(model: SpringMassModel, direction: Float[ndarray, "spring 3"]) -> csr_array:
    """Map tensions of springs to forces on the object nodes, three rows a node."""
    count = len(direction)
    spring = np.repeat(np.arange(count), 3)
    rows, columns, values = [], [], []
    for end, sign in ((0, 1.0), (1, -1.0)):
        node = model.spring_nodes[:, end].astype(np.int64)
        is_object = np.repeat(node < model.node_count, 3)
        rows.append((3 * node[:, None] + np.arange(3)).ravel()[is_object])
        columns.append(spring[is_object])
        values.append(sign * direction.ravel()[is_object])
    return csr_array(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        shape=(3 * model.node_count, count),
    )


def _balance(
    forces: tuple[csr_array, Int[ndarray, " resting"]],
    load: Float[ndarray, " row"],
    start: Float[ndarray, " spring"],
    ease: Float[ndarray, " spring"],
    share: float,
) -> Float[ndarray, " spring"]:
    """Find tensions that, with the ground's push at some nodes, add up to a load.

    What a tension changes costs the square of it over its `ease`, the ground's push next to
    nothing; a `share` of the largest term says how dear it is to leave load uncarried.
    """
    (pulls, touching), tension = forces, start.copy()
    push = np.zeros(len(touching))
    easier = csr_array(pulls * (ease / ease.max()) ** 2)
    normal = csr_array(easier @ pulls.T)
    largest = max(float(normal.diagonal().max()), np.finfo(np.float64).tiny)
    pushes = np.ones(len(touching), dtype=bool)
    for _ in range(MOST_ROUNDS):
        given = np.full(len(load), share * largest)
        given[3 * touching[pushes] + 2] += EASE_OF_GROUND * largest
        missing = load - pulls @ tension
        missing[3 * touching + 2] -= push
        solved = splu(csc_array(normal + diags_array(given))).solve(missing)
        tension += easier.T @ solved
        push[pushes] += EASE_OF_GROUND * largest * solved[3 * touching[pushes] + 2]
        # The ground does not pull: such nodes hang.
        hangs = pushes & (push < 0.0)
        if not hangs.any():
            break
        pushes &= ~hangs
        tension = start.copy()
        push[:] = 0.0
    return tension
