"""Axes that are carried along a curve, or with a tangent over time, without twist about it."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray


def unit_across(
    axis: Float[ndarray, "*batch 3"], tangent: Float[ndarray, "*batch 3"]
) -> Float[ndarray, "*batch 3"]:
    """Give the unit vector across a unit tangent that is nearest to an axis."""
    rest = axis - (axis * tangent).sum(axis=-1, keepdims=True) * tangent
    return rest / np.linalg.norm(rest, axis=-1, keepdims=True)


def parallel_transport(
    axis: Float[ndarray, "*batch 3"], tangent: Float[ndarray, "*batch step 3"]
) -> Float[ndarray, "*batch step 3"]:
    """Turn an axis with a tangent, from each step to the next one on the shortest way.

    Args:
        axis: Axis at the first step.
        tangent: Unit tangents.
    """
    first = np.broadcast_to(np.eye(3), (*axis.shape[:-1], 1, 3, 3))
    turn = np.concatenate([first, rotations(tangent[..., :-1, :], tangent[..., 1:, :])], axis=-3)
    step = 1
    while (
        step < tangent.shape[-2]
    ):  # All products from the start on, in logarithmically many steps.
        turn[..., step:, :, :] = turn[..., step:, :, :] @ turn[..., :-step, :, :]
        step *= 2
    return (turn @ axis[..., None, :, None])[..., 0]


def rotations(
    start: Float[ndarray, "*batch 3"], end: Float[ndarray, "*batch 3"]
) -> Float[ndarray, "*batch 3 3"]:
    """Give the smallest rotations that turn unit vectors into others.

    An opposite one is reached by half a turn about some axis across.
    """
    axis = np.cross(start, end)
    cosine = np.sum(start * end, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(axis, -1, 0)
    zero = np.zeros_like(x)
    skew = np.stack(
        [np.stack(row, axis=-1) for row in ([zero, -z, y], [z, zero, -x], [-y, x, zero])], axis=-2
    )
    turn = np.eye(3) + skew + skew @ skew / np.maximum(1.0 + cosine, 1e-6)
    is_opposite = cosine[..., 0, 0] < -1.0 + 1e-12
    if is_opposite.any():
        vector = np.broadcast_to(start, axis.shape)[is_opposite]
        least = np.eye(3)[np.abs(vector).argmin(axis=-1)]
        across = unit_across(least, vector)
        turn[is_opposite] = 2.0 * across[:, :, None] * across[:, None, :] - np.eye(3)
    return turn
