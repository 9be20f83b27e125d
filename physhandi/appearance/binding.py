"""How the nodes of an object carry its splats, in any rollout.

A splat follows the nodes that are nearest to it at rest. Each turns what is around it by the
rotation that takes the offsets to its own neighbors at rest to those of now best, in the sense of
least squares (linear blend skinning, as PhysTwin does). Rotations are always found from the rest
pose, so nothing adds up over the frames, and a frame can be carried without those before it.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int
from numpy import ndarray
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from physhandi.appearance.splats import Splats
from physhandi.parallel_transport import rotations as shortest_rotations

NODES_OF_A_SPLAT = 16
"""Nodes that a splat follows, and neighbors by which a node tells how it has turned."""
_CLOSEST = 1e-6
"""Added to distances, so that a node has a finite weight at its own place [m]."""
_THIN = 0.01
"""Neighbors whose squares of extents have a smaller ratio than this are taken to be on a line."""
_POINT = 1e-14
"""Neighbors with a smaller square of their extent are taken to be at one place [m²]."""
_NEWTON_STEPS = 12
"""Steps to the sum of singular values; 8 are enough to the last digit where these are apart."""
_DOUBTFUL, _CONVERGED = 1e-3, 1e-12
"""Rotations are decomposed one by one below this product of the sums of two singular values each,
or sum of the squares of their products, and above this last step, with a norm of 1."""
_PART = 1 << 16
"""Rotations that are found at once."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SplatBinding:
    """Which nodes carry which splats; fixed at rest."""

    rest_node: Float[ndarray, "node 3"]
    """Nodes at rest [m]."""
    rest_center: Float[ndarray, "splat 3"]
    """Middles of the splats at rest [m]."""
    node: Int[ndarray, "splat near"]
    """Nodes that carry a splat, the nearest first."""
    weight: Float[ndarray, "splat near"]
    """Share of each of them; rows sum to one."""
    neighbor: Int[ndarray, "node beside"]
    """Nodes by which a node tells how it has turned."""

    @classmethod
    def of(cls, splats: Splats) -> "SplatBinding":
        """Bind splats to the nodes that are nearest to them at rest.

        Nodes that are fewer than `NODES_OF_A_SPLAT` carry all splats together.
        """
        rest = splats.rest_node.astype(np.float64)
        center = splats.center.astype(np.float64)
        tree = KDTree(rest)
        distance, node = _nearest(tree, center, min(NODES_OF_A_SPLAT, len(rest)))
        weight = 1.0 / (distance + _CLOSEST)
        _, neighbor = _nearest(tree, rest, min(NODES_OF_A_SPLAT + 1, len(rest)))
        return cls(
            rest_node=rest,
            rest_center=center,
            node=node,
            weight=weight / weight.sum(axis=1, keepdims=True),
            neighbor=_without_self(neighbor),
        )

    def carry(self, node: Float[ndarray, "frame node 3"]) -> Float32[ndarray, "frame splat 3"]:
        """Find where splats are when the nodes are somewhere.

        Args:
            node: The nodes in some frames [m].

        Returns:
            Middles of the splats in these frames [m].

        Raises:
            ValueError: If the nodes are not as many as at rest, or not finite; names the frame.
        """
        turned = self.rotations(node)
        count = len(self.rest_node)
        carried = np.empty((len(node), len(self.rest_center), 3), np.float32)
        for frame, place in enumerate(node):
            # Row 3 k + a is column a of the rotation of node k.
            columns = np.swapaxes(turned[frame], 1, 2).reshape(3 * count, 3)
            carried[frame] = self.blend @ np.concatenate([columns, place.astype(np.float64)])
        return carried

    def rotations(self, node: Float[ndarray, "frame node 3"]) -> Float[ndarray, "frame node 3 3"]:
        """Find how far the surroundings of each node have turned since rest.

        They are the rotations of a polar decomposition. Neighbors in a plane still determine one.
        Those on a line do not, and are turned the shortest way; a node whose neighbors are at its
        own place is not turned.

        Args:
            node: The nodes in some frames [m].

        Raises:
            ValueError: If the nodes are not as many as at rest, or not finite; names the frame.
        """
        if node.shape[1:] != self.rest_node.shape:
            raise ValueError(
                f"node has shape {node.shape}; expected (frame, {len(self.rest_node)}, 3)."
            )
        wrong = np.flatnonzero(~np.isfinite(node).all(axis=(1, 2)))
        if len(wrong):
            raise ValueError(f"Frame {wrong[0]} has nodes that are not finite.")
        turned = np.empty((*node.shape, 3))
        step = max(_PART // node.shape[1], 1)
        for first in range(0, len(node), step):
            place = node[first : first + step].astype(np.float64)
            now = place[:, self.neighbor] - place[:, :, None]
            turned[first : first + step] = polar_rotations(np.swapaxes(now, -1, -2) @ self._arm)
        return turned

    @cached_property
    def _arm(self) -> Float[ndarray, "node beside 3"]:
        """Offsets from nodes to their neighbors at rest [m]."""
        return self.rest_node[self.neighbor] - self.rest_node[:, None]

    @cached_property
    def blend(self) -> Any:
        """Sparse matrix from the columns of all rotations, after them the nodes, to the splats."""
        splats, near = self.node.shape
        count = len(self.rest_node)
        offset = self.rest_center[:, None] - self.rest_node[self.node]
        value = np.concatenate(
            [(self.weight[..., None] * offset).reshape(splats, -1), self.weight], axis=1
        )
        column = np.concatenate(
            [
                (3 * self.node[..., None] + np.arange(3)).reshape(splats, -1),
                3 * count + self.node,
            ],
            axis=1,
        )
        start = 4 * near * np.arange(splats + 1)
        return csr_array((value.ravel(), column.ravel(), start), shape=(splats, 4 * count))


def _nearest(
    tree: KDTree, point: Float[ndarray, "point 3"], count: int
) -> tuple[Float[ndarray, "point near"], Int[ndarray, "point near"]]:
    distance, index = tree.query(point, k=count)
    size = (len(point), count)  # One neighbor has no axis of its own.
    return np.asarray(distance).reshape(size), np.asarray(index).reshape(size)


def _without_self(neighbor: Int[ndarray, "node near"]) -> Int[ndarray, "node beside"]:
    """Leave every node out of its own neighbors, or the farthest if others are at its place."""
    is_self = neighbor == np.arange(len(neighbor))[:, None]
    is_self[~is_self.any(axis=1), -1] = True
    return neighbor[~is_self].reshape(len(neighbor), -1)


def polar_rotations(
    moment: Float[ndarray, "*batch 3 3"], *, thin: float = _THIN
) -> Float[ndarray, "*batch 3 3"]:
    """Find the rotation R for which the trace of R' M is greatest.

    Neighbors on a line say nothing of the turn about it, which is the shortest one then. Where the
    rotation is beyond doubt it has a closed form (F. L. Markley, Attitude determination using
    vector observations: a fast optimal matrix algorithm, 1993) in the greatest trace, that is the
    sum of the singular values, the last with the sign of the determinant; the others are decomposed
    one by one, which takes ten times as long.

    Args:
        moment: Sums M of products of an offset of now with the same one at rest [m²].
        thin: Ratio of squares of extents below which offsets are taken to be on a line.
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
        shortest = shortest_rotations(right[is_thin][:, 0], left[is_thin][..., 0])
        # Little by little, so that neighbors that leave a line do not turn at once.
        full = moment[is_thin] + lacks[is_thin][:, None, None] * shortest
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
