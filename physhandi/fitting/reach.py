"""Tells before a simulation whether any spring can form at frame 0, and which distance forbids it.

Springs are found at frame 0 alone (paper, section 3.3), so what is too far apart then never joins.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import KDTree

from physhandi.errors import FitError, UsageError
from physhandi.fitting.object_problem import ObjectProblem
from physhandi.fitting.search import SearchConfig
from physhandi.simulation.model import SimulationParameters, SpringMassModel
from physhandi.simulation.topology import MINIMUM_LENGTH


def check_problem(
    problem: ObjectProblem, start: SimulationParameters, config: SearchConfig
) -> None:
    """Refuse an object whose springs no candidate of the search could form.

    Args:
        problem: One sequence of the search.
        start: Values that the search starts from.
        config: Intervals of the search.

    Raises:
        FitError: If control nodes are too far from the object, or its nodes from each other, or in
            one place; names both the distance and the widest radius.
    """

    def widest(field: str) -> float:
        variable = config.variables.get(field)
        return max(getattr(start, field), 0.0 if variable is None else variable.high)

    radius = widest("virtual_connection_radius")
    gap = _control_gap(problem.control[0], problem.object_node)
    if gap >= radius and problem.control.shape[1] > 0:
        raise FitError(
            f"Sequence '{problem.name}': at frame 0 the control nodes are {gap:.3g} m or more away "
            f"from the object, but virtual springs reach {radius:.3g} m at most "
            "(virtual_connection_radius): nothing would hold it. Check that hands or control.npy "
            "lie in the object's world and unit, and that they touch it at frame 0."
        )
    radius = widest("connection_radius")
    gap = _node_gap(problem.rest_node)
    if gap >= radius and len(problem.rest_node) > 1:
        what = "in one place" if np.isinf(gap) else f"{gap:.3g} m or more apart"
        raise FitError(
            f"Sequence '{problem.name}': the {len(problem.rest_node)} object nodes are {what}, but "
            f"springs join nodes that are more than {MINIMUM_LENGTH:g} m and less than "
            f"{radius:.3g} m apart (connection_radius): it would fall to pieces. Give more nodes, "
            "or a profile that searches a wider radius."
        )


def check_springs(
    name: str,
    model: SpringMassModel,
    parameters: SimulationParameters,
    control_0: Float[ndarray, "control 3"],
    rest_node: Float[ndarray, "node 3"],
) -> None:
    """Refuse parameters under which a sequence's object falls to pieces or is held by nothing.

    Args:
        name: Name of the sequence.
        model: Springs that the parameters make.
        parameters: Radii and neighbor limits, for the message.
        control_0: Positions of the control nodes at frame 0 [m].
        rest_node: The object's rest shape [m].

    Raises:
        UsageError: If there is no object spring, or no virtual one; names the value to change.
    """
    if model.object_spring_count == 0 and model.node_count > 1:
        raise UsageError(
            f"No object spring forms in sequence '{name}': {_cause(parameters, '')} and the "
            f"nearest nodes are {_node_gap(rest_node):.3g} m apart. Raise connection_radius above "
            "that, and max_neighbors to at least 1."
        )
    if model.virtual_spring_count == 0 and len(control_0):
        gap = _control_gap(control_0, model.object_node)
        raise UsageError(
            f"No virtual spring forms in sequence '{name}': {_cause(parameters, 'virtual_')} and "
            f"the nearest control node is {gap:.3g} m from the object. Raise "
            "virtual_connection_radius above that, and virtual_max_neighbors to at least 1."
        )


def _cause(parameters: SimulationParameters, prefix: str) -> str:
    radius = getattr(parameters, f"{prefix}connection_radius")
    most = getattr(parameters, f"{prefix}max_neighbors")
    return f"{prefix}connection_radius is {radius:.3g} m, {prefix}max_neighbors is {most},"


def _control_gap(control: ndarray, node: ndarray) -> float:
    """Distance between the object and the nearest control node [m]."""
    return float(KDTree(node).query(control)[0].min(initial=np.inf))


def _node_gap(node: ndarray) -> float:
    """Distance of the nearest two nodes that may be joined; infinite if there are none [m]."""
    count = min(len(node), 64)
    distance = np.reshape(KDTree(node).query(node, k=count)[0], -1)
    return float(distance[distance > MINIMUM_LENGTH].min(initial=np.inf))
