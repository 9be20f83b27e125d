"""Intervals of the search: for an object of this size, and wider where the search ended at a bound.

`fit_intervals` scales the intervals that a profile states for one object to another one;
`bounds_met` and `widened` serve the search and the warnings of a run.
"""

import math
from collections.abc import Mapping
from collections.abc import Sequence as Many
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree

from physhandi.fitting.config import SearchConfig, SearchVariable
from physhandi.fitting.object_problem import ObjectProblem
from physhandi.simulation.parameters import PARAMETERS, SimulationParameters

NEAR_BOUND = 0.02
"""Part of an interval beside its end within which a parameter counts as being there."""
WIDENING = 0.5
"""Part of an interval's length, as it is walked, by which it is lengthened at an end."""
STANDARD_GRAVITY = 9.81
"""Gravity under which the profiles' intervals hold [m/s²]."""
_PATH_REACH = 2.5
"""Node spacings that one step of a path along the object may span."""
_COARSEST_GRIP = 3.0
"""Most node spacings that the distance of two control nodes counts as: they may be two hands."""
NEAR_GRIP = 1.5
"""Node spacings beyond which a control node is away from what it holds."""
_FARTHEST_GRIP = 8.0
"""Node spacings up to which the virtual radius follows control nodes that are away."""


@dataclass(frozen=True, kw_only=True)
class ObjectSize:
    """Size of an object, from which its parameters are scaled; lengths in the recording's unit."""

    spacing: float
    """Mean distance of the nodes from their two nearest neighbors, at rest."""
    length: float
    """Longest of the shortest ways along the object, from node to node."""
    gravity: float
    """Acceleration downwards."""
    grip: float
    """The same of the control nodes at frame 0; at least the node spacing, and at most three."""
    gap: float
    """Distance between the object and the nearest control node: at frame 0, or, if contacts are
    followed over time, the median over frames of what it was when those that hold then began (0 if
    there are none)."""


def measure_object(problems: Many[ObjectProblem]) -> ObjectSize:
    """Measure an object, and how it is held in the recordings that it is fitted to.

    Args:
        problems: One for each recording; all have the same rest shape.
    """
    node = problems[0].rest_node.astype(np.float64)
    spacing = neighbor_distance(node)
    held = [problem for problem in problems if problem.control.shape[1]]
    grips = [neighbor_distance(problem.control[0].astype(np.float64)) for problem in held]
    gaps = [_gap(problem) for problem in held]
    gravity = abs(problems[0].gravity)
    return ObjectSize(
        spacing=spacing,
        length=object_length(node, spacing),
        gravity=gravity if gravity > 0 else STANDARD_GRAVITY,
        grip=float(np.clip(max(grips, default=0.0), spacing, _COARSEST_GRIP * spacing)),
        gap=float(max(gaps, default=0.0)),
    )


def _gap(problem: ObjectProblem) -> float:
    if problem.contacts is None:
        return float(KDTree(problem.object_node).query(problem.control[0])[0].min())
    # Most of the time, since what touches for a moment and slides off holds nothing.
    return problem.contacts.median_distance(problem.frame_count)


def neighbor_distance(node: Float[ndarray, "node 3"]) -> float:
    """Average over nodes the mean distance to their two nearest neighbors; 0 for a single node [m].

    Along a rope, in a sheet and in a block that is the distance of neighbors, unlike that of four.
    """
    count = min(3, len(node))
    if count < 2:
        return 0.0
    distance = np.asarray(KDTree(node).query(node, k=count)[0])
    return float(distance[:, 1:].mean())


def object_length(node: Float[ndarray, "node 3"], spacing: float) -> float:
    """Measure the longest of the shortest ways along an object [m].

    Ways lead from node to near node, so a rope is as long when it lies in a bow as when it is
    straight. Of an object in several pieces the largest one counts.

    Args:
        node: Nodes at rest [m].
        spacing: Mean distance of neighbors [m].
    """
    pairs = KDTree(node).query_pairs(_PATH_REACH * spacing, output_type="ndarray")
    if not len(pairs):
        return spacing
    step = np.linalg.norm(node[pairs[:, 1]] - node[pairs[:, 0]], axis=1)
    graph = coo_array((step, (pairs[:, 0], pairs[:, 1])), shape=(len(node), len(node))).tocsr()
    piece = connected_components(graph, directed=False)[1]
    middle = int(np.flatnonzero(piece == np.bincount(piece).argmax())[0])
    # From one end, the farthest from wherever one begins, to the other.
    return _farthest(graph, _farthest(graph, middle)[0])[1]


def _farthest(graph: Any, start: int) -> tuple[int, float]:
    """Find the node of a piece that is farthest from one of its nodes, and how far that is."""
    distance = dijkstra(graph, directed=False, indices=start)
    distance[np.isinf(distance)] = -1.0
    end = int(distance.argmax())
    return end, float(distance[end])


def scale_factors(size: ObjectSize, config: SearchConfig) -> dict[str, float]:
    """Compute by how much each parameter is larger than for the object that a profile is meant for.

    All nodes weigh the same, so a strand of springs along an object of length L with nodes at a
    distance h carries L/h of them: the stiffness that bounds its strain goes with g L/h, and the
    dashpot that is critical beside such a spring with √(g L)/h. Radii go with h.

    Returns:
        A factor for each parameter that has one; nothing if the intervals are not to be scaled.
    """
    reference = config.reference_spacing
    if reference is None or size.spacing <= 0:
        return {}
    finer = size.spacing / reference
    factors = {
        "connection_radius": finer,
        "virtual_connection_radius": finer,
        "collision_distance": finer,
    }
    if config.reference_length is not None:
        longer = size.gravity / STANDARD_GRAVITY * size.length / config.reference_length
        factors["stiffness"] = factors["virtual_stiffness"] = longer / finer
        factors["damping"] = math.sqrt(longer) / finer
    return factors


def fit_intervals(
    config: SearchConfig, start: SimulationParameters, size: ObjectSize
) -> tuple[SearchConfig, SimulationParameters]:
    """Scale the intervals of a search to an object, as far as its settings ask for it.

    The virtual radius then reaches at least half a node spacing farther than twice to the nearest
    control node, and one and a half times as far as control nodes are apart, unless that is farther
    than hands that hold an object are. If that control node is away, all of the interval reaches
    it: where no spring is laid an object lies still, which fits better than much that moves. A
    start outside of its scaled interval is scaled likewise, one inside stays.

    Returns:
        Settings whose intervals are those of this object, and where its search starts.
    """
    factors = scale_factors(size, config)
    intervals: dict[str, SearchVariable] = {}
    begin: dict[str, float] = {}
    for name, variable in config.variables.items():
        if name not in factors or not variable.is_scaled:
            intervals[name] = variable
            continue
        low, high = (_allowed(name, factors[name] * end) for end in (variable.low, variable.high))
        if name == "virtual_connection_radius":
            reach = max(2.0 * size.gap + 0.5 * size.spacing, 1.5 * size.grip)
            farthest = _FARTHEST_GRIP * size.spacing
            high = max(high, _allowed(name, min(reach, farthest)))
            least = size.gap + 0.5 * size.spacing
            if size.gap > NEAR_GRIP * size.spacing and least < high:
                low = max(low, least)
        intervals[name] = variable.replace(low=low, high=high)
        value = float(getattr(start, name))
        if not low <= value <= high:
            begin[name] = min(max(factors[name] * value, low), high)
    return config.replace(variables=intervals), start.replace(**begin)


def bounds_met(
    parameters: SimulationParameters, intervals: Mapping[str, SearchVariable]
) -> dict[str, float]:
    """Find the searched parameters that are at an end of their interval.

    An end that is the parameter's own bound, such as no drag, is none that a search could pass;
    nor is a single neighbor, without which there is no spring.

    Returns:
        The end, by the parameter's name.
    """
    met: dict[str, float] = {}
    for name, variable in intervals.items():
        value = float(getattr(parameters, name))
        unit = variable.to_unit(value)
        is_whole = variable.scale == "integer"
        goes_on_below = _allowed(name, variable.low - 1e-12) < variable.low
        goes_on_above = _allowed(name, variable.high * (1 + 1e-9) + 1e-12) > variable.high
        if unit <= NEAR_BOUND and goes_on_below and not (is_whole and variable.low <= 1):
            met[name] = variable.low
        # Whole numbers are rounded down.
        is_high = unit >= 1 - NEAR_BOUND or (is_whole and value >= variable.high - 1)
        if is_high and goes_on_above:
            met[name] = variable.high
    return met


def widened(
    intervals: Mapping[str, SearchVariable], ends: Mapping[str, float]
) -> dict[str, SearchVariable]:
    """Lengthen intervals by half at the ends that were met, as far as a parameter may go."""
    result = dict(intervals)
    for name, end in ends.items():
        variable = intervals[name]
        is_high = end == variable.high
        if variable.scale == "log":
            ratio = (variable.high / variable.low) ** WIDENING
            farther = end * ratio if is_high else end / ratio
        else:
            more = WIDENING * (variable.high - variable.low)
            farther = end + more if is_high else end - more
        side = "high" if is_high else "low"
        result[name] = variable.replace(**{side: _allowed(name, farther)})
    return result


def interval_text(name: str, variable: SearchVariable) -> str:
    """Write an interval for people."""
    unit = PARAMETERS[name].unit
    return f"{variable.low:.4g} to {variable.high:.4g}{f' {unit}' if unit else ''}"


def _allowed(name: str, value: float) -> float:
    """Keep a value within the parameter's own bounds."""
    low, high = PARAMETERS[name].low, PARAMETERS[name].high
    value = value if low is None else max(value, low)
    return value if high is None else min(value, high)
