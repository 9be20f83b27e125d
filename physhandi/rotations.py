"""Rotations: the smallest between vectors, the best between points, without twist or jumps."""

import math

import numpy as np
from jaxtyping import Float
from numpy import ndarray

_NO_LENGTH = 1e-12
"""Vectors shorter than this have no direction."""
_LINE = 1e-9
"""Ratio of squares of extents below which points are on a line but for rounding."""
_POINT = 1e-18
"""Points with a smaller square of their extent are taken to be at one place [m²]."""
_NEWTON_STEPS = 12
"""Steps to the sum of singular values; 8 are enough to the last digit where these are apart."""
_DOUBTFUL, _CONVERGED = 1e-3, 1e-12
"""Rotations are decomposed one by one below this product of the sums of two singular values each,
or sum of the squares of their products, and above this last step, with a norm of 1."""


def unit(vector: Float[ndarray, "*batch 3"]) -> Float[ndarray, "*batch 3"]:
    """Give unit vectors; a vector without a length stays zero."""
    return vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), _NO_LENGTH)


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
    turn = np.concatenate(
        [first, smallest_rotations(tangent[..., :-1, :], tangent[..., 1:, :])], axis=-3
    )
    step = 1
    while (
        step < tangent.shape[-2]
    ):  # All products from the start on, in logarithmically many steps.
        turn[..., step:, :, :] = turn[..., step:, :, :] @ turn[..., :-step, :, :]
        step *= 2
    return (turn @ axis[..., None, :, None])[..., 0]


def smallest_rotations(
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


def best_rotations(
    moment: Float[ndarray, "*batch 3 3"], *, thin: float = _LINE
) -> Float[ndarray, "*batch 3 3"]:
    """Find the rotation R for which the trace of R' M is greatest (Kabsch).

    Points on a line say nothing of the turn about it, which is the shortest one then; a single
    point does not turn. Where the rotation is beyond doubt it has a closed form (F. L. Markley,
    Attitude determination using vector observations: a fast optimal matrix algorithm, 1993) in the
    greatest trace, that is the sum of the singular values, the last with the sign of the
    determinant; the others are decomposed one by one, which takes ten times as long.

    Args:
        moment: Sums M of products t s' of points s, from their middle, and where they come to, t
            from theirs, with any weights [m²].
        thin: Ratio of squares of extents below which points are taken to be on a line.

    Returns:
        R, by which R s is nearest to t in the sense of least squares.
    """
    every = moment.reshape(-1, 3, 3)
    square = np.einsum("nij,nij->n", every, every)
    unit = every / np.sqrt(np.where(square > 0.0, square, 1.0))[:, None, None]
    # As rows of one number each; sums over so many short axes would take most of the time.
    m = unit.reshape(-1, 9).T.copy()
    minor = _cofactors(m)
    determinant = m[0] * minor[0] + m[1] * minor[1] + m[2] * minor[2]
    minors = np.square(minor).sum(axis=0)
    greatest, step = np.full(len(every), math.sqrt(3.0)), np.zeros(len(every))
    # Newton's method comes down to the greatest root, as every real one is at most √3.
    for _ in range(_NEWTON_STEPS):
        excess = greatest * greatest - 1.0
        slope = 4.0 * (greatest * excess - 2.0 * determinant)
        value = excess * excess - 8.0 * greatest * determinant - 4.0 * minors
        step = value / np.where(slope > 0.0, slope, 1.0)
        greatest = greatest - step
    half = 0.5 * (greatest * greatest - 1.0)
    size = half * greatest - determinant
    is_sure = (square > _POINT**2) & (size > _DOUBTFUL) & (minors > _DOUBTFUL)
    is_sure &= np.abs(step) < _CONVERGED
    turned = np.empty_like(unit)
    if is_sure.any():
        raised = np.swapaxes(unit, 1, 2) @ unit
        sum_of = (half + 1.0) * m + greatest * minor - (unit @ raised).reshape(-1, 9).T
        turned[:] = (sum_of / np.where(is_sure, size, 1.0)).T.reshape(-1, 3, 3)
    if not is_sure.all():
        turned[~is_sure] = _decomposed(every[~is_sure], thin)
    return turned.reshape(moment.shape)


def without_jumps(rotation: Float[ndarray, "frame *batch 4"]) -> Float[ndarray, "frame *batch 4"]:
    """Choose of q and -q, which are the same rotation, the one nearer to the frame before."""
    flips = np.where((rotation[1:] * rotation[:-1]).sum(axis=-1) < 0.0, -1.0, 1.0)
    sign = np.concatenate([np.ones_like(flips[:1]), np.cumprod(flips, axis=0)])
    return rotation * sign[: len(rotation), ..., None]


def _cofactors(m: Float[ndarray, "9 item"]) -> Float[ndarray, "9 item"]:
    """Compute the cofactors of matrices; row after row of each, as they are given."""
    return np.stack(
        [
            m[4] * m[8] - m[5] * m[7],
            m[5] * m[6] - m[3] * m[8],
            m[3] * m[7] - m[4] * m[6],
            m[2] * m[7] - m[1] * m[8],
            m[0] * m[8] - m[2] * m[6],
            m[1] * m[6] - m[0] * m[7],
            m[1] * m[5] - m[2] * m[4],
            m[2] * m[3] - m[0] * m[5],
            m[0] * m[4] - m[1] * m[3],
        ]
    )


def _decomposed(moment: Float[ndarray, "item 3 3"], thin: float) -> Float[ndarray, "item 3 3"]:
    """Do the same by singular values, whatever they are."""
    left, size, right = np.linalg.svd(moment)
    turned = _proper(left, right)
    lacks = thin * size[..., 0] - size[..., 1]
    is_thin = (lacks > 0.0) & (size[..., 0] > _POINT)
    if is_thin.any():
        shortest = smallest_rotations(right[is_thin][:, 0], left[is_thin][..., 0])
        # Little by little, so that points that leave a line do not turn at once. On one the share
        # does not matter, and a small one would lose digits.
        is_line = size[is_thin][:, 1] <= _LINE * size[is_thin][:, 0]
        share = np.where(is_line, size[is_thin][:, 0], lacks[is_thin])
        full = moment[is_thin] + share[:, None, None] * shortest
        left, _, right = np.linalg.svd(full)
        turned[is_thin] = _proper(left, right)
    turned[size[..., 0] <= _POINT] = np.eye(3)
    return turned


def _proper(
    left: Float[ndarray, "*batch 3 3"], right: Float[ndarray, "*batch 3 3"]
) -> Float[ndarray, "*batch 3 3"]:
    """Multiply the factors of a singular value decomposition so that nothing is mirrored."""
    sign = np.sign(np.linalg.det(left) * np.linalg.det(right))
    left = left.copy()
    left[..., 2] *= sign[..., None]
    return left @ right
