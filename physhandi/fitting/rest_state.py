"""The object at rest in frame 0: how far above the ground its nodes touch it.

Nodes are points of the surface that cameras see, mostly the upper one. What lies on the ground
keeps them above it by its thickness, and there they stay: each node that rests at frame 0 has the
height at which it was seen as its *clearance*, the height at which it touches the ground.
"""

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray
from scipy.spatial import KDTree

NEAR_GROUND = 1.25
"""Height below which the lowest node of its column rests on the ground, in distances of nodes."""
COLUMN_RADIUS = 0.75
"""Horizontal distance of nodes that stand one above the other, in distances of nodes."""
COLUMN_STEP = 0.25
"""Least difference of their heights, in distances of nodes."""
NEIGHBORHOOD = 2.5
"""Radius in which an object is thick or thin, in distances of nodes."""
THIN = 0.45
"""Largest standard deviation across a thin object's neighborhoods, in distances of nodes."""


def resting_clearance(
    node: Float[ndarray, "node 3"], ground_height: float | None
) -> Float32[ndarray, " node"]:
    """Find the height above the ground at which each node touches it [m].

    A node rests if it is near the ground and the lowest of its column; its clearance is its own
    height. Other nodes of a thin object, a sheet or a rope, come to lie as high as those that rest
    (the median of them); others of a thick object touch the ground themselves.

    Args:
        node: Object nodes at frame 0 [m].
        ground_height: Height of the ground; None without ground [m].

    Returns:
        Clearances; all 0 where nothing rests on the ground.
    """
    clearance = np.zeros(len(node), np.float32)
    if ground_height is None or len(node) < 2:
        return clearance
    point = np.asarray(node, dtype=np.float64)
    spacing = node_distance(point)
    height = np.maximum(point[:, 2] - ground_height, 0.0)
    is_resting = (height < NEAR_GROUND * spacing) & _is_lowest(point, spacing)
    if not is_resting.any():
        return clearance
    if is_thin(point, spacing):
        clearance[:] = np.median(height[is_resting])
    clearance[is_resting] = height[is_resting]
    return clearance


def node_distance(node: Float[ndarray, "node 3"]) -> float:
    """Return the median distance from a node to the one nearest to it [m]."""
    return float(np.median(KDTree(node).query(node, k=2)[0][:, 1]))


def is_thin(node: Float[ndarray, "node 3"], spacing: float) -> bool:
    """Whether most nodes have their neighbors in one layer, flat or bent, or in a line.

    Args:
        node: Object nodes [m].
        spacing: Distance between neighboring nodes [m].
    """
    near = KDTree(node).query_ball_point(node, NEIGHBORHOOD * spacing)
    across = [np.linalg.eigvalsh(np.cov(node[others].T, ddof=0))[0] for others in near]
    return bool(np.sqrt(max(float(np.median(across)), 0.0)) < THIN * spacing)


def _is_lowest(node: ndarray, spacing: float) -> ndarray:
    """Mark the nodes below which no other one stands."""
    flat, height = node[:, :2], node[:, 2]
    pairs = KDTree(flat).query_pairs(COLUMN_RADIUS * spacing, output_type="ndarray")
    step = height[pairs[:, 1]] - height[pairs[:, 0]]
    upper = np.where(step > 0.0, pairs[:, 1], pairs[:, 0])[np.abs(step) > COLUMN_STEP * spacing]
    lowest = np.ones(len(node), dtype=bool)
    lowest[upper] = False
    return lowest
