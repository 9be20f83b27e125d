"""Distances between simulated and observed shapes, and the baselines to compare with."""

from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import KDTree  # pyright: ignore[reportMissingTypeStubs]  # it has none

DYNAMIC_THRESHOLD = 0.01
"""An observed point is dynamic if it moves farther than this from where it was first [m]."""

Norm = Literal["l1", "l2"]


def nearest_distance(
    point: Float[ndarray, "point 3"], target: Float[ndarray, "target 3"], norm: Norm = "l2"
) -> Float[ndarray, " point"]:
    """Measure how far each point is from the nearest target, both by the same norm [m]."""
    if len(target) == 0:
        raise ValueError("there is no target to measure a distance to")
    if len(point) == 0:
        return np.zeros(0)
    tree: Any = KDTree(target)
    return np.asarray(tree.query(point, p=1 if norm == "l1" else 2)[0], dtype=np.float64)


def chamfer_one_way(
    observed: Float[ndarray, "point 3"], predicted: Float[ndarray, "node 3"], norm: Norm = "l2"
) -> float:
    """Average the distance from observed points to the nearest predicted node [m].

    With ``"l1"`` it is PhysTwin's measure: ``|dx| + |dy| + |dz|``, observed to predicted only.
    """
    return float(nearest_distance(observed, predicted, norm).mean()) if len(observed) else np.nan


def chamfer_symmetric(
    first: Float[ndarray, "first 3"], second: Float[ndarray, "second 3"]
) -> float:
    """Average the two one-way means of Euclidean distances between two point sets [m]."""
    return 0.5 * (chamfer_one_way(first, second) + chamfer_one_way(second, first))


def dynamic_tracks(
    point: Float[ndarray, "frame track 3"],
    is_visible: Bool[ndarray, "frame track"],
    threshold: float = DYNAMIC_THRESHOLD,
) -> Bool[ndarray, " track"]:
    """Tell which tracks move farther than `threshold` [m] from frame 0 in any frame.

    A track that frame 0 does not show counts from the first frame that shows it.
    """
    if len(point) == 0 or point.shape[1] == 0:
        return np.zeros(point.shape[1], dtype=bool)
    start = np.take_along_axis(point, is_visible.argmax(axis=0)[None, :, None], axis=0)
    distance = np.linalg.norm(point - start, axis=2)
    return np.where(is_visible, distance, 0.0).max(axis=0) > threshold


def track_error(
    point: Float[ndarray, "frame track 3"],
    is_visible: Bool[ndarray, "frame track"],
    rollout: Float[ndarray, "frame node 3"],
    node_of_track: Int[ndarray, " track"],
) -> Float[ndarray, " frame"]:
    """Average over visible tracks how far each is from its node [m]; NaN where none is visible."""
    distance = np.linalg.norm(point - rollout[:, node_of_track], axis=2)
    return _masked_mean(distance, is_visible)


def marker_error(
    marker: Float[ndarray, "frame marker 3"],
    rollout: Float[ndarray, "frame node 3"],
    marker_node: Int[ndarray, " marker"],
    markers: Int[ndarray, " scored"],
) -> Float[ndarray, " frame"]:
    """Average over the given markers how far each is from its node [m]; NaN where none is seen."""
    chosen = marker[:, markers]
    is_seen = np.asarray(np.isfinite(chosen).all(axis=2))
    return track_error(chosen, is_seen, rollout, marker_node[markers])


def nearest_node(
    point: Float[ndarray, "track 3"], node: Float[ndarray, "node 3"]
) -> Int[ndarray, " track"]:
    """Give the node nearest to each point."""
    if len(point) == 0:
        return np.zeros(0, dtype=np.int64)
    tree: Any = KDTree(node)
    return np.asarray(tree.query(point)[1], dtype=np.int64)


def rigid_transform(
    source: Float[ndarray, "point 3"], target: Float[ndarray, "point 3"]
) -> tuple[Float[ndarray, "3 3"], Float[ndarray, " 3"]]:
    """Find the rotation and translation that move `source` best onto `target` (Kabsch).

    Where the points leave a rotation open because they lie on a line, the smallest one is taken.

    Returns:
        Rotation R and translation t [m] such that ``source @ R.T + t`` is nearest to `target`.
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    covariance = (target - target_mean).T @ (source - source_mean)
    u, singular, vt = np.linalg.svd(covariance)
    if singular[1] <= 1e-9 * max(float(singular[0]), 1e-300):
        rotation = np.eye(3) if singular[0] < 1e-18 else _smallest_rotation(vt[0], u[:, 0])
    else:
        sign = np.sign(np.linalg.det(u @ vt))
        rotation = u @ np.diag([1.0, 1.0, sign]) @ vt
    return rotation, target_mean - rotation @ source_mean


def static_baseline(
    object_node: Float[ndarray, "node 3"], frame_count: int
) -> Float[ndarray, "frame node 3"]:
    """Leave the object where it is in frame 0 [m]."""
    return np.broadcast_to(object_node, (frame_count, *object_node.shape))


def rigid_follow_baseline(
    object_node: Float[ndarray, "node 3"], control: Float[ndarray, "frame control 3"]
) -> Float[ndarray, "frame node 3"]:
    """Move the object of frame 0 rigidly with the control nodes [m]."""
    start = control[0].astype(np.float64)
    moved = np.empty((len(control), *object_node.shape))
    for frame, nodes in enumerate(control.astype(np.float64)):
        rotation, translation = rigid_transform(start, nodes)
        moved[frame] = object_node @ rotation.T + translation
    return moved


def reprojection_error(
    projected: Float[ndarray, "frame joint 2"], keypoint: Float[ndarray, "frame joint 3"]
) -> Float[ndarray, " frame"]:
    """Average how far projected joints are from detected ones [px]; NaN where none is detected.

    Args:
        projected: Pixels of the model's joints.
        keypoint: Pixel x, y and confidence of the detections; NaN where not seen.
    """
    distance = np.linalg.norm(projected - keypoint[..., :2], axis=2)
    return _masked_mean(distance, np.isfinite(distance))


def _masked_mean(
    value: Float[ndarray, "frame item"], mask: Bool[ndarray, "frame item"]
) -> Float[ndarray, " frame"]:
    count = mask.sum(axis=1)
    total = np.where(mask, value, 0.0).sum(axis=1, dtype=np.float64)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _smallest_rotation(source: ndarray, target: ndarray) -> Float[ndarray, "3 3"]:
    """Turn one unit vector onto another about the axis perpendicular to both."""
    cosine = float(source @ target)
    if cosine < -1 + 1e-12:  # Half a turn; any perpendicular axis will do.
        least = np.eye(3)[np.abs(source).argmin()]
        perpendicular = np.cross(source, least)
        perpendicular /= np.linalg.norm(perpendicular)
        return 2 * np.outer(perpendicular, perpendicular) - np.eye(3)
    axis = np.cross(source, target)
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.eye(3) + cross + cross @ cross / (1 + cosine)
