"""Control nodes: every vertex of the hands prescribes motion to the object."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.hand.model import HandModel
from physhandi.hand.motion import HandMotion


def control_trajectory(
    motions: Sequence[HandMotion], models: Sequence[HandModel]
) -> Float[ndarray, "frame control 3"]:
    """Join the vertices of all hands into one trajectory of control nodes.

    Args:
        motions: Motion of each hand, in the order of the sequence's hands.
        models: Model of each hand, in the same order.

    Returns:
        Positions of the control nodes, hands in order [length unit of the sequence].

    Raises:
        ValueError: If there is no hand, or the hands cover different numbers of frames.
    """
    frames = [motion.frame_count for motion in motions]
    if not frames or min(frames) != max(frames):
        raise ValueError(f"control nodes need hands that cover the same frames, not {frames}")
    vertices = [motion.vertices(model) for motion, model in zip(motions, models, strict=True)]
    return np.concatenate(vertices, axis=1)
