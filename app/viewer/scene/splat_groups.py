"""Splats in groups that move as rigid bodies, so that a frame sends a pose a group and no splat.

viser's page keeps what a splat node holds and moves the node; it sorts and blends the splats of all
nodes together. What bends within a group is lost: where a group is drawn is the rigid motion that
takes its splats nearest to where their nodes carry them.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int
from numpy import ndarray
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from physhandi.appearance.binding import SplatBinding
from physhandi.appearance.splats import Splats
from physhandi.rotations import best_rotations

MOST_GROUPS = 64
"""Most groups of one object."""
_FEWEST = 8
"""Splats that a group has on average, unless it is one of `MOST_GROUPS`."""
_SEED = 0
_ROUNDS = 20


@dataclass(frozen=True, eq=False, kw_only=True)
class SplatGroups:
    """The splats of an object, each in one group."""

    splats: Splats
    """The splats."""
    binding: SplatBinding
    """Binding of the splats to nodes."""
    group: Int[ndarray, " splat"]
    """Number of each splat's group; none is empty."""

    @classmethod
    def of(cls, splats: Splats, most: int = MOST_GROUPS) -> "SplatGroups":
        """Put splats that are near each other at rest into groups of about the same size.

        Args:
            splats: At least one splat.
            most: Most groups.
        """
        from scipy.cluster import vq  # Few objects have splats, and all servers would import it.

        untyped: Any = vq
        center = splats.center.astype(np.float64)
        count = max(min(most, len(center) // _FEWEST), 1)
        start = np.random.default_rng(_SEED)
        group = untyped.kmeans2(center, count, _ROUNDS, minit="++", rng=start)[1]
        # Of groups that became empty nothing is kept.
        _, group = np.unique(group, return_inverse=True)
        return cls(splats=splats, binding=SplatBinding.of(splats), group=group)

    @property
    def count(self) -> int:
        """Number of groups."""
        return len(self.middle)

    @cached_property
    def middle(self) -> Float[ndarray, "group 3"]:
        """Mean of each group's splats at rest [m]."""
        size = np.bincount(self.group)[:, None]
        center = self.splats.center.astype(np.float64)
        return np.stack([np.bincount(self.group, along) for along in center.T], axis=1) / size

    def poses(
        self, node: Float[ndarray, "node 3"]
    ) -> tuple[Float[ndarray, "group 4"], Float[ndarray, "group 3"]]:
        """Find where the groups are when the nodes are somewhere.

        Args:
            node: The nodes [m].

        Returns:
            Rotations since rest as quaternions (w first), and where the middles are [m].
        """
        turned = self.binding.rotations(node[None])[0]
        columns = np.swapaxes(turned, 1, 2).reshape(-1, 3)
        sums: ndarray = self._sums @ np.concatenate([columns, node.astype(np.float64)])
        middle, moment = sums[: self.count], sums[self.count :].reshape(3, self.count, 3)
        turn = best_rotations(np.moveaxis(moment, 0, -1), thin=0.0)
        return Rotation.from_matrix(turn).as_quat(scalar_first=True), middle

    def place(self, node: Float[ndarray, "node 3"]) -> Float32[ndarray, "splat 3"]:
        """Find where the splats are drawn when the nodes are somewhere [m]."""
        turn, middle = self.poses(node)
        offset = self.splats.center - self.middle[self.group]
        turned = Rotation.from_quat(turn[self.group], scalar_first=True).apply(offset)
        return (turned + middle[self.group]).astype(np.float32)

    @cached_property
    def _sums(self) -> Any:
        """Sparse matrix from rotations and nodes to the middle and the moments of each group.

        Row g is the mean of the splats x of group g; row (1 + j) count + g is the sum over them of
        x times coordinate j of their offsets at rest. Both are linear in what moves the splats.
        """
        number = np.arange(len(self.group))
        share = 1.0 / np.bincount(self.group)[self.group]
        offset = self.splats.center - self.middle[self.group]
        row = [self.group + at * self.count for at in range(4)]
        sums = csr_array(
            (np.concatenate([share, *offset.T]), (np.concatenate(row), np.tile(number, 4))),
            shape=(4 * self.count, len(number)),
        )
        return sums @ self.binding.blend
