"""Rotations over time as quaternions."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray


def without_jumps(rotation: Float[ndarray, "frame *batch 4"]) -> Float[ndarray, "frame *batch 4"]:
    """Choose of q and -q, which are the same rotation, the one nearer to the frame before."""
    flips = np.where((rotation[1:] * rotation[:-1]).sum(axis=-1) < 0.0, -1.0, 1.0)
    sign = np.concatenate([np.ones_like(flips[:1]), np.cumprod(flips, axis=0)])
    return rotation * sign[: len(rotation), ..., None]
