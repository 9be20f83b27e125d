"""What any prediction must beat."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.metrics.alignment import rigid_transform


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
