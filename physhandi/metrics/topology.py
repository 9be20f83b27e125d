"""Radius-to-resolution deviation of a fitted topology."""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import KDTree

REFERENCE_RATIO = 3.0
"""Connection radius over resolution that peridynamics recommends."""
_NEIGHBORS = 4


def resolution(node: Float[ndarray, "node 3"]) -> float:
    """Average over nodes the mean distance to their four nearest neighbours: Δx [m].

    Raises:
        ValueError: If there are fewer than two nodes.
    """
    if len(node) < 2:
        raise ValueError(f"{len(node)} nodes have no distance to their neighbours")
    tree: Any = KDTree(node)
    distance = tree.query(node, k=min(_NEIGHBORS + 1, len(node)))[0]
    return float(np.asarray(distance)[:, 1:].mean())


def radius_deviation(connection_radius: float, node_spacing: float) -> float:
    """Compute the Radius-to-Resolution Deviation ``RRD = |(δ/Δx)/3 - 1|`` of the paper.

    Args:
        connection_radius: δ of object or virtual springs [m].
        node_spacing: Δx, as `resolution` gives it [m].
    """
    return abs(connection_radius / node_spacing / REFERENCE_RATIO - 1.0)
