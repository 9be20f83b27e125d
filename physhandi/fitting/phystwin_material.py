"""From PhysTwin's optimised numbers to our parameters and springs.

PhysTwin stores no topology: it is built again, and a checkpoint's stiffnesses are dealt out in the
order in which PhysTwin's loops find the springs (reference: its published code, 44f17cc).
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import KDTree

from physhandi.data.importers.phystwin_experiment import Checkpoint, Contact, Optimum
from physhandi.errors import ImportFailedError
from physhandi.simulation.model import SimulationParameters, SpringMassModel
from physhandi.simulation.topology import MINIMUM_LENGTH, build_model

STIFFEST = 1e5
"""PhysTwin simulates no spring stiffer than this [N]."""
_LIMITS = {
    "restitution": ("collide_elas", 1.0),
    "friction": ("collide_fric", 2.0),
    "self_restitution": ("collide_object_elas", 1.0),
    "self_friction": ("collide_object_fric", 2.0),
}


def phystwin_parameters(
    base: SimulationParameters,
    optimum: Optimum,
    contact: Contact,
    *,
    truncates_damping: bool,
    self_collision: bool,
) -> tuple[SimulationParameters, list[str]]:
    """Turn what PhysTwin found into the parameters with which its simulator moves.

    Args:
        base: PhysTwin's fixed choices (profile ``phystwin``).
        optimum: Result of its search.
        contact: Collision coefficients of the search, or of the checkpoint.
        truncates_damping: Whether dashpot and drag lose their decimals, as PhysTwin's second stage
            and its inference do when they load the search's result.
        self_collision: Whether nodes collide.

    Returns:
        The parameters, and a sentence for each number that is not the stored one.
    """
    notes: list[str] = []
    stiffness = min(optimum.stiffness, STIFFEST)
    if stiffness != optimum.stiffness:
        notes.append(_changed("global_spring_Y", optimum.stiffness, stiffness, "simulated"))
    bounced: dict[str, float] = {}
    for name, (field, most) in _LIMITS.items():
        value = getattr(contact, name)
        bounced[name] = min(max(value, 0.0), most)
        if bounced[name] != value:
            notes.append(_changed(field, value, bounced[name], "simulated"))
    damping, drag = optimum.damping, optimum.drag
    if truncates_damping:
        damping, drag = float(int(damping)), float(int(drag))
        for field, value, used in (
            ("dashpot_damping", optimum.damping, damping),
            ("drag_damping", optimum.drag, drag),
        ):
            if used != value:
                notes.append(_changed(field, value, used, "loaded (as a whole number)"))
    parameters = replace(
        base,
        connection_radius=optimum.object_radius,
        # PhysTwin counts the node itself.
        max_neighbors=optimum.object_max_neighbours - 1,
        virtual_connection_radius=optimum.controller_radius,
        virtual_max_neighbors=optimum.controller_max_neighbours,
        stiffness=stiffness,
        virtual_stiffness=stiffness,
        damping=damping,
        drag=drag,
        self_collision=self_collision,
        collision_distance=optimum.collision_distance,
        **bounced,
    )
    return parameters, notes


def phystwin_model(
    object_node: Float[ndarray, "node 3"],
    control_0: Float[ndarray, "control 3"],
    parameters: SimulationParameters,
    checkpoint: Checkpoint | None = None,
    *,
    source: Path | None = None,
) -> tuple[SpringMassModel, list[str]]:
    """Build PhysTwin's springs, and give each the stiffness that a checkpoint has for it.

    Args:
        object_node: Object nodes at frame 0, in PhysTwin's order [m].
        control_0: Controller points at frame 0 [m].
        parameters: What `phystwin_parameters` returned.
        checkpoint: Stiffnesses; without one, all springs get the global one.
        source: File of the checkpoint, for messages.

    Returns:
        The model at rest, and a sentence about stiffnesses that are not the stored ones.

    Raises:
        ImportFailedError: If the checkpoint has another number of springs than the topology.
    """
    model = build_model(object_node, control_0, parameters)
    if checkpoint is None:
        return model, []
    found = (model.object_spring_count, len(model.spring_nodes))
    stored = (checkpoint.object_spring_count, len(checkpoint.stiffness))
    if found != stored:
        raise ImportFailedError(
            f"{source}: has {stored[1]} springs, {stored[0]} of them between object nodes, but "
            f"final_data.pkl and optimal_params.pkl give {found[1]}, {found[0]} of them between "
            "object nodes. Give the files of one and the same experiment."
        )
    number, tie_count = spring_numbers(model, parameters, control_0)
    stiffness = checkpoint.stiffness[number]
    too_stiff = int((stiffness > STIFFEST).sum())
    notes = [f"{too_stiff} springs stiffer than {STIFFEST:g} N are simulated with that."]
    notes = notes if too_stiff else []
    if tie_count:
        notes.append(
            f"{tie_count} pairs of neighbors are at the same distance from a node. Which of them "
            "PhysTwin found first is not defined, so their stiffnesses may be exchanged."
        )
    # PhysTwin leaves a spring without stiffness out, its dashpot included.
    damping = np.where(stiffness > 0.0, model.damping, 0.0)
    fitted = replace(
        model,
        stiffness=np.minimum(stiffness, STIFFEST).astype(np.float32),
        damping=damping.astype(np.float32),
    )
    return fitted, notes


def spring_numbers(
    model: SpringMassModel,
    parameters: SimulationParameters,
    control_0: Float[ndarray, "control 3"],
) -> tuple[Int[ndarray, " spring"], int]:
    """Tell for each spring of a model which number it has in PhysTwin's list.

    PhysTwin walks over the nodes; each searches its neighbours by ascending distance, drops the
    first hit (itself) and adds every pair that is not there yet. Then the controllers add all their
    hits, one controller after the other.

    Args:
        model: A model that `build_model` made from `parameters`.
        parameters: Radii and neighbor limits.
        control_0: Controller points at frame 0 [m].

    Returns:
        A permutation of the springs' numbers, and how many pairs of neighbors have no defined order
        because they are at exactly the same distance.
    """
    node = model.object_node.astype(np.float64)
    tree, count = KDTree(node), len(node)
    distance, hit = _search(tree, node, parameters.max_neighbors + 1)
    hit, distance = hit[:, 1:], distance[:, 1:]
    own = np.broadcast_to(np.arange(count)[:, None], hit.shape)
    joined = (distance < parameters.connection_radius) & (distance > MINIMUM_LENGTH) & (hit != own)
    first, second = own[joined], hit[joined]  # row by row: in the order of the walk
    key = np.minimum(first, second) * count + np.maximum(first, second)
    # The model's springs ascend as the unique keys do.
    discovery = np.unique(key, return_index=True)[1]
    tie_count = _ties(distance, joined)
    control_point = np.asarray(control_0, np.float64)
    distance, hit = _search(tree, control_point, parameters.virtual_max_neighbors)
    held = distance < parameters.virtual_connection_radius
    control = np.broadcast_to(np.arange(len(control_0))[:, None], hit.shape)
    order = np.argsort(hit[held] * len(control_0) + control[held])
    number = np.concatenate([np.argsort(np.argsort(discovery)), len(discovery) + order])
    return number, tie_count + _ties(distance, held)


def _ties(distance: ndarray, is_kept: ndarray) -> int:
    """Count neighbors in a row that are at the same distance."""
    is_same = (distance[:, 1:] == distance[:, :-1]) & is_kept[:, 1:] & is_kept[:, :-1]
    return int(is_same.sum())


def _search(tree: KDTree, query: ndarray, most: int) -> tuple[ndarray, ndarray]:
    """Give distance and index of the nearest nodes, ascending, a row for each query."""
    count = min(most, tree.n)
    distance, hit = tree.query(query, k=count)
    shape = (len(query), count)
    return np.reshape(distance, shape), np.reshape(hit, shape)


def _changed(field: str, stored: float, used: float, how: str) -> str:
    return f"{field} {stored:.6g} is {how} as {used:g}, as PhysTwin does."
