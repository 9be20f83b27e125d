"""Distance between two rollouts: node by node if they are of one object, else to the surface.

The one place where this is computed. The comparison of two runs uses it, and so does the color
"difference" of a re-simulated object: ``take_difference(rollout, frame, fitted, frame)``.
"""

from dataclasses import dataclass
from itertools import combinations
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import KDTree

from physhandi.object_rollout import ObjectRollout
from physhandi.triangles import segment_distance, triangle_distance

Way = Literal["nodes", "surface"]
"""Whether a node is compared with the same node, or with the other object's surface."""
AROUND = 4
"""Nearest nodes of the other object that span the surface next to a point."""
_SAME_NODE = 1e-4
"""Nodes are the same if they begin nearer to each other than this part of the object's size."""


@dataclass(frozen=True, kw_only=True)
class FrameDifference:
    """Distance between two rollouts in one frame, over the nodes that were compared."""

    mean: float
    """Mean distance [m]."""
    strong: float
    """Distance that 5 % of the nodes exceed [m]."""
    largest: float
    """Largest distance [m]."""


def way_of(first: ObjectRollout, second: ObjectRollout) -> Way:
    """Tell how two rollouts can be compared.

    They are of one object if they have as many nodes and each begins at the same place; then a
    node is compared with itself. Otherwise, as when the fits sampled the object differently, it is
    compared with the surface of the other one.
    """
    one, other = first.model.object_node, second.model.object_node
    if one is other:
        return "nodes"
    if one.shape != other.shape or len(one) == 0:
        return "surface"
    size = float(np.linalg.norm(np.ptp(one, axis=0)))
    is_same = bool(np.abs(one - other).max() <= _SAME_NODE * size)
    return "nodes" if is_same else "surface"


def rollout_difference(
    rollout: ObjectRollout,
    frame: int,
    other: ObjectRollout,
    other_frame: int,
    way: Way | None = None,
) -> Float[ndarray, " node"]:
    """Measure how far each node of a rollout's frame is from a frame of another rollout [m].

    Args:
        rollout: Whose nodes are measured.
        frame: One of its frames that is ready.
        other: The rollout that it is compared with.
        other_frame: One of its frames that is ready.
        way: What `way_of` says of the two; None to ask it.
    """
    point = np.asarray(rollout.position[frame], dtype=np.float64)
    compared = np.asarray(other.position[other_frame], dtype=np.float64)
    if (way or way_of(rollout, other)) == "nodes":
        return node_difference(point, compared)
    return surface_difference(point, compared)


def summarize(distance: Float[ndarray, " node"]) -> FrameDifference:
    """Put the distances of a frame into three numbers; NaN without nodes."""
    if len(distance) == 0:
        return FrameDifference(mean=np.nan, strong=np.nan, largest=np.nan)
    return FrameDifference(
        mean=float(distance.mean()),
        strong=float(np.quantile(distance, 0.95)),
        largest=float(distance.max()),
    )


def compare_frames(
    first: ObjectRollout, first_frame: int, second: ObjectRollout, second_frame: int, way: Way
) -> FrameDifference:
    """Measure how far apart two rollouts are in a frame; by surface, over the nodes of both."""
    distance = rollout_difference(first, first_frame, second, second_frame, way)
    if way == "surface":
        back = rollout_difference(second, second_frame, first, first_frame, way)
        distance = np.concatenate([distance, back])
    return summarize(distance)


def node_difference(
    point: Float[ndarray, "node 3"], other: Float[ndarray, "node 3"]
) -> Float[ndarray, " node"]:
    """Measure how far each node is from the same node of the other object [m]."""
    return np.linalg.norm(point - other, axis=-1)


def surface_difference(
    point: Float[ndarray, "node 3"], other: Float[ndarray, "other 3"]
) -> Float[ndarray, " node"]:
    """Measure how far each node is from the surface of an object that is known by its nodes [m].

    The surface next to a point are the triangles between the `AROUND` nodes nearest to it, so two
    samplings of one sheet differ by nothing, where the distance of nodes would be half a spacing.

    Args:
        point: Points to measure.
        other: The object's nodes.

    Returns:
        Distances; infinite if the other object has no nodes.
    """
    count = min(AROUND, len(other))
    if count == 0:
        return np.full(len(point), np.inf)
    tree: Any = KDTree(other)
    far, near = tree.query(point, k=[*range(1, count + 1)])
    distance = np.asarray(far[:, 0], dtype=np.float64)
    corner = other[near]
    if count == 2:
        return np.minimum(distance, segment_distance(point, corner[:, 0], corner[:, 1]))
    for three in combinations(range(count), 3):
        distance = np.minimum(distance, triangle_distance(point, corner[:, three]))
    return distance
