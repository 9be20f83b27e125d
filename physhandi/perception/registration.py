"""Lays a known object into what another first frame shows: rigidly, and then bent to its shape."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.sparse import bsr_array, coo_array, csc_array, csr_array, kron
from scipy.sparse.linalg import splu
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from physhandi.unique_rows import unique_rows

NEIGHBORS = 8
"""Nodes beside each node that keep their distance from it while the object is bent."""
STIFFNESSES = (10.0, 3.0, 1.0, 0.3)
"""Weights of the shape against the cloud, in turn: the object begins stiff and softens."""
ROUNDS = 20
"""How often, with each weight, cloud points are given to the nodes that they are nearest to."""
CLOUD_NEIGHBORS = 12
"""Cloud points from which the directions of the surface at a node are found."""
POINT_ERROR = 0.3
"""Error of a mean of cloud points across the surface, in distances of nodes."""
ALONG = 0.1
"""Least pull along the surface, in terms of that across it."""


def lay_object(
    template: Float[ndarray, "node 3"], cloud: Float[ndarray, "point 3"], *, iterations: int = 40
) -> Float[ndarray, "node 3"]:
    """Move a known object rigidly onto the cloud of another sequence's frame 0.

    Point-to-point ICP from eight headings around the vertical; the best result wins. It assumes
    that the object starts in about the shape in which it was first reconstructed.

    Args:
        template: Nodes of the object in the sequence that it was fitted on [m].
        cloud: Object points at frame 0 of the other sequence [m].
        iterations: Alignment steps from each heading.
    """
    tree = KDTree(cloud)
    best, best_error = template, np.inf
    for turn in np.arange(8) * np.pi / 4:
        heading = Rotation.from_euler("z", turn).as_matrix()
        node = (template - template.mean(axis=0)) @ heading.T + cloud.mean(axis=0)
        for _ in range(iterations):
            target = cloud[tree.query(node)[1]]
            centred = node - node.mean(axis=0)
            rotation = Rotation.align_vectors(target - target.mean(axis=0), centred)[0]
            node = rotation.apply(centred) + target.mean(axis=0)
        error = float(
            np.mean(tree.query(node)[0] ** 2) + np.mean(KDTree(node).query(cloud)[0] ** 2)
        )
        if error < best_error:
            best, best_error = node, error
    return best.astype(np.float32)


def bend_object(
    laid: Float[ndarray, "node 3"],
    cloud: Float[ndarray, "point 3"],
    ground_height: float | None = None,
) -> Float[ndarray, "node 3"]:
    """Bend an object that was laid onto a cloud, so that its nodes lie on what the cloud shows.

    The neighborhood of every node moves as rigidly as possible (Sorkine and Alexa, "As-rigid-as-
    possible surface modeling", 2007), so the object bends and hardly stretches. The cloud points
    whose nearest node is the same pull it to their mean, more across the surface than along it
    (Segal et al., "Generalized-ICP", 2009). Nodes that are nearest to none, such as hidden ones,
    follow the others.

    Args:
        laid: Nodes of the object about where it is, in the shape that it keeps if it can [m].
        cloud: Object points [m].
        ground_height: No node comes below it [m]; None without ground.
    """
    start = np.asarray(laid, dtype=np.float64)
    shape = _Neighborhoods.of(start)
    tree = KDTree(cloud)
    node = start
    for stiffness in STIFFNESSES:
        for _ in range(ROUNDS):
            seen, count, mean = _means(node, cloud)
            pull = _pulls_across(cloud, tree, mean, shape.spacing)
            pull *= (count * len(node) / len(cloud))[:, None, None]
            node = shape.bent(node, stiffness, (seen, mean, pull))
            if ground_height is not None:
                node[:, 2] = np.maximum(node[:, 2], ground_height)
    return node.astype(np.float32)


@dataclass(frozen=True)
class _Neighborhoods:
    """Offsets between near nodes, which the shape is made of."""

    spacing: float
    """Median distance to the nearest node [m]."""
    pair: Int[ndarray, "pair 2"]
    """A node and one that is near it; each pair in both orders."""
    offset: Float[ndarray, "pair 3"]
    """From the first node to the second [m]."""
    difference: csr_array
    """Maps nodes to these offsets."""
    normal: csr_array
    """Normal matrix of all coordinates of these offsets."""

    @classmethod
    def of(cls, node: Float[ndarray, "node 3"]) -> "_Neighborhoods":
        count = min(NEIGHBORS + 1, len(node))
        query = KDTree(node).query(node, k=count)
        distance, near = (np.asarray(columns) for columns in query)
        first = np.repeat(np.arange(len(node)), count - 1)
        one_way = np.stack([first, near[:, 1:].ravel()], axis=1)
        pair = unique_rows(np.concatenate([one_way, one_way[:, ::-1]]))[0]
        row = np.tile(np.arange(len(pair)), 2)
        sign = np.repeat([-1.0, 1.0], len(pair))
        entries = coo_array((sign, (row, pair.T.ravel())), shape=(len(pair), len(node)))
        difference = csr_array(entries)
        return cls(
            spacing=float(np.median(distance[:, 1])),
            pair=pair,
            offset=node[pair[:, 1]] - node[pair[:, 0]],
            difference=difference,
            normal=csr_array(kron(difference.T @ difference, np.eye(3))),
        )

    def bent(
        self,
        node: Float[ndarray, "node 3"],
        stiffness: float,
        pulls: tuple[ndarray, Float[ndarray, "seen 3"], Float[ndarray, "seen 3 3"]],
    ) -> Float[ndarray, "node 3"]:
        """Turn every neighborhood as it lies now, and find the nodes that fit best.

        Args:
            node: Nodes before [m].
            stiffness: Weight of the shape.
            pulls: Nodes that are pulled, where to [m], and how strongly in each direction.
        """
        seen, target, weight = pulls
        count = len(node)
        wanted = self._turned(node)
        every = np.zeros((count, 3, 3))
        every[seen] = weight
        load = stiffness * (self.difference.T @ wanted)
        load[seen] += np.einsum("nij,nj->ni", weight, target)
        blocks = bsr_array((every, np.arange(count), np.arange(count + 1)))
        matrix = csc_array(stiffness * self.normal + csr_array(blocks))
        solver = splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        return solver.solve(load.ravel()).reshape(-1, 3)

    def _turned(self, node: Float[ndarray, "node 3"]) -> Float[ndarray, "pair 3"]:
        """Turn each offset as the neighborhoods of both of its nodes have turned, on average."""
        now = node[self.pair[:, 1]] - node[self.pair[:, 0]]
        spread = np.zeros((len(node), 3, 3))
        np.add.at(spread, self.pair[:, 0], self.offset[:, :, None] * now[:, None, :])
        left, _, right = np.linalg.svd(spread)
        back = np.swapaxes(right, 1, 2)
        # A flat neighborhood may be turned over, not mirrored.
        back[:, :, 2] *= np.linalg.det(back @ np.swapaxes(left, 1, 2))[:, None]
        turn = back @ np.swapaxes(left, 1, 2)
        mean = 0.5 * (turn[self.pair[:, 0]] + turn[self.pair[:, 1]])
        return np.einsum("pij,pj->pi", mean, self.offset)


def _means(
    node: Float[ndarray, "node 3"], cloud: Float[ndarray, "point 3"]
) -> tuple[Int[ndarray, " seen"], Int[ndarray, " seen"], Float[ndarray, "seen 3"]]:
    """Average the cloud points that have the same nearest node."""
    nearest = KDTree(node).query(cloud)[1]
    count = np.bincount(nearest, minlength=len(node))
    total = np.zeros((len(node), 3))
    np.add.at(total, nearest, cloud)
    seen = np.flatnonzero(count)
    return seen, count[seen], total[seen] / count[seen, None]


def _pulls_across(
    cloud: Float[ndarray, "point 3"], tree: KDTree, mean: Float[ndarray, "seen 3"], spacing: float
) -> Float[ndarray, "seen 3 3"]:
    """Weigh the directions at each mean: 1 across the surface, less the farther it goes on."""
    near = tree.query(mean, k=min(CLOUD_NEIGHBORS, len(cloud)))[1]
    offset = cloud[near] - cloud[near].mean(axis=1, keepdims=True)
    spread = np.einsum("npi,npj->nij", offset, offset) / offset.shape[1]
    error = (POINT_ERROR * spacing) ** 2
    across = error * np.linalg.inv(spread + error * np.eye(3))
    return ALONG * np.eye(3) + (1.0 - ALONG) * across
