"""Baseline predictions: static object, rigid motion with the hands, last residual."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import KDTree  # pyright: ignore[reportMissingTypeStubs]  # it has none

from physhandi.metrics.alignment import CARRIERS, carried_points, rigid_transform


def static_baseline(
    object_node: Float[ndarray, "node 3"], frame_count: int
) -> Float[ndarray, "frame node 3"]:
    """Keep the object in its state of frame 0 [m]."""
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


def last_residual_baseline(
    rollout: Float[ndarray, "frame node 3"],
    point: Float[ndarray, "frame track 3"],
    is_visible: Bool[ndarray, "frame track"],
    first_future: int,
    node_of_track: Int[ndarray, " track"] | None = None,
) -> Float[ndarray, "frame node 3"]:
    """Shift the predicted frames of a rollout by its residual in the last observed frame [m].

    Args:
        rollout: Simulated nodes [m].
        point: Observed tracks [m].
        is_visible: Whether a track is visible.
        first_future: First frame that was held out; only frames before it are read.
        node_of_track: Node that each track observes; None lets the nodes around it carry it.

    Returns:
        The rollout as it is up to `first_future`; from there on every node is shifted by the
        residual of the eight tracks nearest to it in frame 0, weighted by inverse distance.

    Raises:
        ValueError: If there is no frame before `first_future`, or the last one shows no track
            whose place on the object is known.
    """
    if not 0 < first_future <= len(rollout):
        raise ValueError(f"first_future is {first_future} of {len(rollout)} frames")
    last = first_future - 1
    is_usable = is_visible[last] if node_of_track is not None else is_visible[last] & is_visible[0]
    if not is_usable.any():
        raise ValueError(f"frame {last} shows no track that frame 0 places on the object")
    start = rollout[0].astype(np.float64)
    if node_of_track is not None:
        anchor = start[node_of_track[is_usable]]
        predicted = rollout[last, node_of_track[is_usable]].astype(np.float64)
    else:
        anchor = point[0, is_usable].astype(np.float64)
        predicted = carried_points(anchor, rollout[[0, last]].astype(np.float64))[1]
    residual = point[last, is_usable] - predicted
    tree: Any = KDTree(anchor)
    count = min(CARRIERS, len(anchor))
    distance, near = tree.query(start, k=count)
    weight = 1.0 / (np.reshape(distance, (-1, count)) + 1e-6)
    weight /= weight.sum(axis=1, keepdims=True)
    shift = np.einsum("nc,nci->ni", weight, residual[np.reshape(near, (-1, count))])
    corrected = rollout.astype(np.float64)
    corrected[first_future:] += shift
    return corrected
