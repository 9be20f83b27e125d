"""Distances between simulated and observed shapes."""

from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import KDTree

DYNAMIC_THRESHOLD = 0.01
"""An observed point is dynamic if it moves farther than this from where it was first [m]."""

Norm = Literal["l1", "l2"]


def nearest_distance(
    point: Float[ndarray, "point 3"],
    target: Float[ndarray, "target 3"] | KDTree,
    norm: Norm = "l2",
) -> Float[ndarray, " point"]:
    """Measure how far each point is from the nearest target, both by the same norm [m].

    Args:
        point: Points [m].
        target: Other points [m], or a tree of them, which saves building one for each call.
        norm: Norm of the distance.

    Raises:
        ValueError: If there is no target.
    """
    tree: Any = target if isinstance(target, KDTree) else KDTree(target)
    if tree.n == 0:
        raise ValueError("there is no target to measure a distance to")
    if len(point) == 0:
        return np.zeros(0)
    return np.asarray(tree.query(point, p=1 if norm == "l1" else 2)[0], dtype=np.float64)


def chamfer_one_way(
    observed: Float[ndarray, "point 3"],
    predicted: Float[ndarray, "node 3"] | KDTree,
    norm: Norm = "l2",
) -> float:
    """Average the distance from observed points to the nearest predicted node [m].

    With ``"l1"`` it is PhysTwin's measure: ``|dx| + |dy| + |dz|``, observed to predicted only.
    A tree of the nodes does as well as the nodes.
    """
    return float(nearest_distance(observed, predicted, norm).mean()) if len(observed) else np.nan


def chamfer_symmetric(
    first: Float[ndarray, "first 3"], second: Float[ndarray, "second 3"]
) -> float:
    """Average the two one-way means of Euclidean distances between two point sets [m].

    NaN if one of the sets is empty.
    """
    if len(first) == 0 or len(second) == 0:
        return np.nan
    return 0.5 * (chamfer_one_way(first, second) + chamfer_one_way(second, first))


def dynamic_tracks(
    point: Float[ndarray, "frame track 3"],
    is_visible: Bool[ndarray, "frame track"],
    threshold: float = DYNAMIC_THRESHOLD,
) -> Bool[ndarray, " track"]:
    """Mark the tracks that move farther than `threshold` [m] from frame 0 in any frame.

    This is the paper's deforming set ``|x_i - x_1|² > τ_dyn``, with τ_dyn = 1e-4 m². A track that
    frame 0 does not show counts from the first frame that shows it.
    """
    if len(point) == 0 or point.shape[1] == 0:
        return np.zeros(point.shape[1], dtype=bool)
    start = np.take_along_axis(point, is_visible.argmax(axis=0)[None, :, None], axis=0)
    distance = np.linalg.norm(point - start, axis=2)
    return np.where(is_visible, distance, 0.0).max(axis=0) > threshold


def dynamic_nodes(
    node: Float[ndarray, "node 3"],
    point: Float[ndarray, "track 3"],
    is_dynamic: Bool[ndarray, " track"],
) -> Bool[ndarray, " node"]:
    """Mark the nodes in the dynamic part: those whose nearest track of frame 0 is dynamic.

    Args:
        node: Nodes in frame 0 [m].
        point: Tracks in frame 0 [m]; NaN where frame 0 does not show one.
        is_dynamic: What `dynamic_tracks` found.
    """
    is_known = np.asarray(np.isfinite(point).all(axis=1))
    if not is_known.any():
        return np.zeros(len(node), dtype=bool)
    return is_dynamic[is_known][nearest_node(node, point[is_known])]


def track_error(
    point: Float[ndarray, "frame track 3"],
    is_visible: Bool[ndarray, "frame track"],
    predicted: Float[ndarray, "frame track 3"],
) -> Float[ndarray, " frame"]:
    """Average over visible tracks how far each is from its prediction [m]; NaN where none is."""
    return masked_mean(np.linalg.norm(point - predicted, axis=2), is_visible)


def track_error_phystwin(
    point: Float[ndarray, "frame track 3"],
    is_visible: Bool[ndarray, "frame track"],
    rollout: Float[ndarray, "frame node 3"],
) -> Float[ndarray, " frame"]:
    """Measure tracks as PhysTwin's evaluation does [m] (physics.md, section 5).

    Each track that frame 0 shows belongs to the node nearest to it there, among all nodes; what
    lies between the two stays in the error. A frame that shows none of them counts as 0.
    """
    shown = np.flatnonzero(is_visible[0])
    node = nearest_node(point[0, shown], rollout[0])
    return np.nan_to_num(track_error(point[:, shown], is_visible[:, shown], rollout[:, node]))


def marker_error(
    marker: Float[ndarray, "frame marker 3"],
    rollout: Float[ndarray, "frame node 3"],
    marker_node: Int[ndarray, " marker"],
    markers: Int[ndarray, " scored"],
) -> Float[ndarray, " frame"]:
    """Average over the given markers how far each is from its node [m]; NaN where none is seen."""
    chosen = marker[:, markers]
    is_seen = np.asarray(np.isfinite(chosen).all(axis=2))
    return track_error(chosen, is_seen, rollout[:, marker_node[markers]])


def nearest_node(
    point: Float[ndarray, "track 3"], node: Float[ndarray, "node 3"]
) -> Int[ndarray, " track"]:
    """Find the node nearest to each point."""
    if len(point) == 0:
        return np.zeros(0, dtype=np.int64)
    tree: Any = KDTree(node)
    return np.asarray(tree.query(point)[1], dtype=np.int64)


def masked_mean(
    value: Float[ndarray, "frame item"], mask: Bool[ndarray, "frame item"]
) -> Float[ndarray, " frame"]:
    """Average each frame's values where the mask is set; NaN where it is nowhere set."""
    count = mask.sum(axis=1)
    total = np.where(mask, value, 0.0).sum(axis=1, dtype=np.float64)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
