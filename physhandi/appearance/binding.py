"""How the nodes of an object carry its splats, in any rollout.

A splat follows the nodes that are nearest to it at rest. Each turns what is around it by the
rotation that takes the offsets to its own neighbors at rest to those of now best, in the sense of
least squares (linear blend skinning, as PhysTwin does). Rotations are always found from the rest
pose, so nothing adds up over the frames, and a frame can be carried without those before it.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int
from numpy import ndarray
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from physhandi.appearance.splats import Splats
from physhandi.rotations import best_rotations

NODES_OF_A_SPLAT = 16
"""Nodes that a splat follows, and neighbors by which a node tells how it has turned."""
_CLOSEST = 1e-6
"""Added to distances, so that a node has a finite weight at its own place [m]."""
_THIN = 0.01
"""Neighbors whose squares of extents have a smaller ratio than this are taken to be on a line."""
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
            moment = np.swapaxes(now, -1, -2) @ self._arm
            turned[first : first + step] = best_rotations(moment, thin=_THIN)
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
