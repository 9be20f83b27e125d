"""Meshes of thick bodies: a stuffed animal of tetrahedra and a closed pillow of triangles."""

from dataclasses import dataclass
from itertools import permutations

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from numpy.random import Generator
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from physhandi.triangles import triangle_areas

_TETRAHEDRON_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
_LEAST_VOLUME = 0.25


@dataclass(frozen=True, eq=False)
class Solid:
    """A mesh whose surface nodes come first."""

    node: Float[ndarray, "node 3"]
    """Nodes [m]."""
    elements: Int[ndarray, "element corner"]
    """Nodes of each tetrahedron of a solid or triangle of a shell."""
    faces: Int[ndarray, "face 3"]
    """Triangles of the surface, seen from outside."""
    surface_node_count: int
    """Nodes that the faces use."""

    def volume(self) -> float:
        """Volume within the surface [m³]."""
        a, b, c = (self.node[self.faces[:, corner]] for corner in range(3))
        return float(np.einsum("fd,fd->", a, np.cross(b, c)) / 6.0)

    def area(self) -> float:
        """Area of the surface [m²]."""
        return float(triangle_areas(self.node, self.faces).sum())


def make_pillow(size: tuple[float, float, float], columns: int) -> Solid:
    """Make a closed shell like a small cushion: two sheets that meet along their rim.

    Args:
        size: Extent along x, y and z [m].
        columns: Pieces along x.
    """
    length, width, height = size
    rows = max(round(columns * width / length), 4)
    u, v = np.meshgrid(np.linspace(-1, 1, columns + 1), np.linspace(-1, 1, rows + 1), indexing="ij")
    bulge = np.sqrt((1 - u**2) * (1 - v**2))
    # Rounding the corners keeps their triangles from being needles.
    x = length / 2 * u * np.sqrt(1 - 0.12 * v**4)
    y = width / 2 * v * np.sqrt(1 - 0.12 * u**4)
    top = np.stack([x, y, height / 2 * bulge], axis=-1).reshape(-1, 3)
    is_rim = ((np.abs(u) == 1) | (np.abs(v) == 1)).ravel()
    below = np.where(is_rim, np.arange(len(top)), 0)
    below[~is_rim] = len(top) + np.arange(np.count_nonzero(~is_rim))
    node = np.concatenate([top, top[~is_rim] * [1, 1, -1]])
    index = np.arange(len(top)).reshape(u.shape)
    a, b, c, d = (
        index[:-1, :-1].ravel(),
        index[1:, :-1].ravel(),
        index[1:, 1:].ravel(),
        index[:-1, 1:].ravel(),
    )
    # Alternate diagonals, so that the sheet bends alike both ways.
    odd = np.add.outer(np.arange(columns), np.arange(rows)).ravel() % 2 == 1
    first = np.where(odd[:, None], np.stack([a, b, d], 1), np.stack([a, b, c], 1))
    second = np.where(odd[:, None], np.stack([b, c, d], 1), np.stack([a, c, d], 1))
    upper = np.concatenate([first, second])
    lower = below[upper][:, ::-1]
    # A triangle with all corners on the rim would lie on its twin.
    flat = is_rim[upper].all(axis=1)
    faces = np.concatenate([upper[~flat], lower[~flat]]).astype(np.int64)
    used = np.unique(faces)
    place = np.full(len(node), -1)
    place[used] = np.arange(len(used))
    faces = place[faces]
    return Solid(node[used], faces, faces, len(used))


def make_plush(
    length: float, spacing: float, random: Generator
) -> tuple[Solid, Float[ndarray, " element"]]:
    """Fill a stuffed animal with tetrahedra.

    Args:
        length: From the feet to the top of the head [m].
        spacing: Distance between neighbouring nodes [m].
        random: Decides how thick head, belly and limbs are.

    Returns:
        The mesh, and how far each element is in limbs (1) rather than in the core (0).
    """
    blobs = _plush_blobs(length, random)
    half = np.array([0.55, 0.45, 0.25]) * length
    low, high = np.floor(-half / spacing).astype(int), np.ceil(half / spacing).astype(int)
    axes = [np.arange(a, b) for a, b in zip(low, high, strict=True)]
    index = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    inside = _outside(blobs, ((index + 0.5) * spacing).reshape(-1, 3)) < 0
    corners, elements = _tetrahedra(index[_without_bare_edges(inside.reshape(index.shape[:3]))])
    node = corners * spacing
    node, elements = _largest_piece(node, elements)
    faces = _surface(elements)
    node = _fit_surface(node, elements, np.unique(faces), blobs, spacing)
    first = np.unique(faces)
    order = np.concatenate([first, np.setdiff1d(np.arange(len(node)), first)])
    place = np.empty(len(node), dtype=np.int64)
    place[order] = np.arange(len(node))
    solid = Solid(node[order], place[elements], place[faces], len(first))
    middle = solid.node[solid.elements].mean(axis=1)
    core = np.linalg.norm((middle - blobs[0, :3]) / blobs[0, 3:], axis=1)
    return solid, np.clip((core - 0.6) / 0.6, 0.0, 1.0)


def _plush_blobs(length: float, random: Generator) -> Float[ndarray, "blob 6"]:
    """Draw ellipsoids (centre, half axes): belly, head, two arms, two legs."""
    thick = random.uniform(0.92, 1.08, 3)
    arm, leg = 0.095 * thick[2], 0.11 * thick[2]
    return length * np.array(
        [
            [-0.08, 0.0, 0.0, 0.25, 0.19 * thick[0], 0.15 * thick[0]],
            [0.29, 0.0, 0.01, 0.19 * thick[1], 0.18 * thick[1], 0.15 * thick[1]],
            [0.06, 0.24, 0.0, arm, 0.17, arm],
            [0.06, -0.24, 0.0, arm, 0.17, arm],
            [-0.32, 0.15, 0.0, 0.19, leg, leg],
            [-0.32, -0.15, 0.0, 0.19, leg, leg],
        ]
    )


def _outside(
    blobs: Float[ndarray, "blob 6"], point: Float[ndarray, "point 3"]
) -> Float[ndarray, " point"]:
    """Estimate each point's distance to the ellipsoids [m]; negative inside."""
    scaled = (point[:, None] - blobs[:, :3]) / blobs[:, 3:]
    radius = np.linalg.norm(scaled, axis=-1)
    slope = np.linalg.norm(scaled / blobs[:, 3:], axis=-1)
    return (radius * (radius - 1.0) / np.maximum(slope, 1e-9)).min(axis=1)


def _without_bare_edges(inside: Bool[ndarray, "x y z"]) -> Bool[ndarray, "x y z"]:
    """Fill cubes where two others share only an edge, so that the surface is a manifold."""
    filled = inside.copy()
    while True:
        before = np.count_nonzero(filled)
        for axis in range(3):
            grid = np.moveaxis(filled, axis, -1)
            a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[:-1, 1:], grid[1:, 1:]
            bare = (a & d & ~b & ~c) | (b & c & ~a & ~d)
            for part in (a, b, c, d):
                np.logical_or(part, bare, out=part)
        if np.count_nonzero(filled) == before:
            return filled


def _tetrahedra(
    cell: Int[ndarray, "cell 3"],
) -> tuple[Int[ndarray, "node 3"], Int[ndarray, "element 4"]]:
    """Cut cubes of a grid into six tetrahedra each, so that neighbours fit."""
    paths = []
    for order in permutations(range(3)):
        path = np.zeros((4, 3), dtype=np.int64)
        for step, axis in enumerate(order):
            path[step + 1] = path[step]
            path[step + 1, axis] += 1
        if np.linalg.det((path[1:] - path[0]).astype(float)) < 0:
            path = path[[0, 2, 1, 3]]
        paths.append(path)
    corner = cell[:, None, None] + np.array(paths)
    node, index = np.unique(corner.reshape(-1, 3), axis=0, return_inverse=True)
    return node, index.reshape(-1, 4)


def _largest_piece(
    node: Float[ndarray, "node 3"], elements: Int[ndarray, "element 4"]
) -> tuple[Float[ndarray, "kept 3"], Int[ndarray, "kept_element 4"]]:
    """Keep the largest connected component."""
    row, column = elements[:, [0, 0, 0]].ravel(), elements[:, 1:].ravel()
    graph = coo_array((np.ones(len(row)), (row, column)), shape=(len(node), len(node)))
    label = connected_components(graph, directed=False)[1]
    is_kept = label == np.argmax(np.bincount(label))
    place = np.cumsum(is_kept) - 1
    return node[is_kept], place[elements[is_kept[elements].all(axis=1)]]


def _surface(elements: Int[ndarray, "element 4"]) -> Int[ndarray, "face 3"]:
    """Find the faces that only one tetrahedron has; they are seen from outside."""
    faces = elements[:, _TETRAHEDRON_FACES].reshape(-1, 3)
    _, index, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    return faces[index[count == 1]]


def _six_volumes(
    node: Float[ndarray, "node 3"], elements: Int[ndarray, "element 4"]
) -> Float[ndarray, " element"]:
    edge = node[elements[:, 1:]] - node[elements[:, :1]]
    return np.linalg.det(edge)


def _fit_surface(
    node: Float[ndarray, "node 3"],
    elements: Int[ndarray, "element 4"],
    surface: Int[ndarray, " surface"],
    blobs: Float[ndarray, "blob 6"],
    spacing: float,
) -> Float[ndarray, "node 3"]:
    """Project surface nodes onto the smooth surface, as far as no tetrahedron collapses."""
    node = node.copy()
    least = _LEAST_VOLUME * spacing**3
    step = 1e-4 * spacing
    for _ in range(12):
        point = node[surface]
        value = _outside(blobs, point)
        slope = np.stack([_outside(blobs, point + step * axis) - value for axis in np.eye(3)], 1)
        slope /= step
        move = -value[:, None] * slope / np.maximum((slope**2).sum(axis=1, keepdims=True), 0.2)
        length = np.linalg.norm(move, axis=1, keepdims=True)
        move *= 0.5 * np.minimum(1.0, 0.3 * spacing / np.maximum(length, 1e-12))
        trial = node.copy()
        trial[surface] += move
        for _ in range(8):
            bad = np.unique(elements[_six_volumes(trial, elements) < least])
            if not len(bad):
                break
            trial[bad] = node[bad]
        if (_six_volumes(trial, elements) >= least).all():
            node = trial
    return node
