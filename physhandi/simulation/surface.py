"""Triangulates a surface through an object's nodes, for display.

A sheet (nodes that lie flat around every node) is triangulated in the tangent planes of its nodes
and stays open at its borders. A volume gets the outside of its alpha shape: of the tetrahedra
between its nodes, those that are no larger than its sampling. What is neither, such as a rope, has
no surface.
"""

from itertools import combinations
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import Delaunay, KDTree, QhullError

from physhandi.unique_rows import unique_rows

_AROUND = 16
"""Neighbors that tell how an object lies around a node."""
_REACH = 2.6
"""Neighbors are not farther away than this many typical distances to the fourth one."""
_LINE, _PLANE = 0.06, 0.18
"""Second and third extent, relative to the one before, below which nodes form a line or plane."""
_LARGEST_CIRCLE, _LARGEST_SPHERE = 1.35, 2.0
"""Largest circumradius of triangles and tetrahedra, in distances to the fourth neighbor."""
_LEAST_VOTES, _GAP_ROUNDS = 2, 3
_OVERLAP = 0.5
"""Cosine of the angle below which two triangles at an edge cover each other."""
_LEAST_LEVEL = 0.7
"""Cosine of the largest angle between one layer over a plane and that plane."""
_LEAST_APART = 0.3
"""Least distance of its nodes in the plane, in typical distances: two layers have nearer ones."""
_FLATTEST = 1e-6
_SHAKE = 0.03
"""Part of the sampling by which nodes are moved, so that no four of a grid lie on one circle."""


def triangulate_nodes(
    node: Float[ndarray, "node 3"], *, kind: str | None = None
) -> Int[ndarray, "face 3"]:
    """Lay triangles through the nodes of an object.

    Args:
        node: Nodes of the object at rest or in its first frame [m].
        kind: ``solid`` for the outside of a volume, ``sheet`` or ``shell`` for one layer of nodes;
            anything else to tell it by the nodes.

    Returns:
        Triangles, turned the same way around wherever they meet; none where the nodes have no
        surface.
    """
    point = np.asarray(node, dtype=np.float64)
    if len(point) < 4 or not np.isfinite(point).all():
        return np.zeros((0, 3), np.int32)
    around = _Neighborhoods(point)
    if around.pitch <= 0.0 or around.is_line:
        return np.zeros((0, 3), np.int32)
    if kind in {"sheet", "shell"} or (kind != "solid" and around.is_flat):
        faces = _height_field(around)
        return _sheet(around) if faces is None else faces
    return _volume(around.point, _LARGEST_SPHERE * around.pitch)


def is_line(node: Float[ndarray, "node 3"]) -> bool:
    """Tell whether nodes lie along a line, as those of a thin rope do."""
    return _Neighborhoods(np.asarray(node, np.float64)).is_line


def typical_distance(node: Float[ndarray, "node 3"]) -> float:
    """Measure the typical distance of a node to its fourth neighbor [m]."""
    return _Neighborhoods(np.asarray(node, np.float64)).pitch


class _Neighborhoods:
    """How an object lies around each of its nodes.

    Attributes:
        point: The nodes, shaken a little.
        pitch: Typical distance to the fourth neighbor [m].
        near: Numbers of the nearest nodes ``(node, neighbor)``, each node its own first one.
        is_near: Which of them are within reach.
        axes: Principal axes of each neighborhood, as rows ``(node, 3, 3)``.
    """

    def __init__(self, point: Float[ndarray, "node 3"]) -> None:
        tree: Any = KDTree(point)
        distance, self.near = tree.query(point, k=min(_AROUND + 1, len(point)))
        self.pitch = float(np.median(distance[:, min(4, len(point) - 1)]))
        self.is_near = distance <= _REACH * self.pitch
        shake = np.random.default_rng(0).uniform(-_SHAKE, _SHAKE, point.shape)
        self.point = point + self.pitch * shake
        self.axes, extent = _local_axes(self.point, self.near, self.is_near)
        second = np.median(extent[:, 1] / np.maximum(extent[:, 0], 1e-12))
        third = np.median(extent[:, 2] / np.maximum(extent[:, 1], 1e-12))
        self.is_line = bool(second < _LINE)
        self.is_flat = bool(third < _PLANE)


def _local_axes(
    point: Float[ndarray, "node 3"],
    near: Int[ndarray, "node neighbor"],
    is_near: Bool[ndarray, "node neighbor"],
) -> tuple[Float[ndarray, "node 3 3"], Float[ndarray, "node 3"]]:
    """Find the principal axes (as rows) and extents of the neighborhood of every node."""
    weight = is_near.astype(np.float64)
    weight /= weight.sum(axis=1, keepdims=True)
    offset = point[near] - np.einsum("nk,nki->ni", weight, point[near])[:, None]
    spread = np.einsum("nk,nki,nkj->nij", weight, offset, offset)
    values, vectors = np.linalg.eigh(spread)
    extent = np.sqrt(np.maximum(values[:, ::-1], 0.0))
    return vectors[:, :, ::-1].transpose(0, 2, 1), extent


def _height_field(around_nodes: _Neighborhoods) -> Int[ndarray, "face 3"] | None:
    """Triangulate one layer over a plane all at once; None if the nodes are not one."""
    point, pitch = around_nodes.point, around_nodes.pitch
    axes = np.linalg.svd(point - point.mean(axis=0), full_matrices=False)[2]
    plane: Any = (point - point.mean(axis=0)) @ axes[:2].T
    if np.abs(around_nodes.axes[:, 2] @ axes[2]).min() < _LEAST_LEVEL:
        return None
    tree: Any = KDTree(plane)
    if tree.query(plane, k=2)[0][:, 1].min() < _LEAST_APART * pitch:
        return None
    faces = Delaunay(plane).simplices.astype(np.int32)
    corner = plane[faces]
    side, other = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    is_turned = side[:, 0] * other[:, 1] < side[:, 1] * other[:, 0]
    faces[is_turned] = faces[is_turned][:, ::-1]
    return faces[_circumradius(point[faces]) <= _LARGEST_CIRCLE * pitch]


def _sheet(around_nodes: _Neighborhoods) -> Int[ndarray, "face 3"]:
    """Keep the triangles on which the tangent planes of their corners agree."""
    point, largest = around_nodes.point, _LARGEST_CIRCLE * around_nodes.pitch
    near, is_near, axes = around_nodes.near, around_nodes.is_near, around_nodes.axes
    votes: dict[tuple[int, ...], int] = {}
    for center in range(len(point)):
        around = near[center, is_near[center]]
        for face in _tangent_triangles(point[around], axes[center, :2], around, center):
            votes[face] = votes.get(face, 0) + 1
    # Those that all corners agree on come first, so that they win where triangles overlap.
    ranked = sorted(votes, key=lambda face: (-votes[face], face))
    faces = np.array(ranked, dtype=np.int64).reshape(-1, 3)
    is_small = _circumradius(point[faces]) <= largest
    is_agreed = np.array([votes[face] >= _LEAST_VOTES for face in ranked], dtype=bool)
    patch = _Patch(point)
    patch.add(faces[is_small & is_agreed], least=0)
    # What one corner alone wants may close gaps between the others.
    for _ in range(_GAP_ROUNDS):
        patch.add(faces[is_small & ~is_agreed], least=2)
    return _oriented(np.array(patch.faces, dtype=np.int64).reshape(-1, 3))


class _Patch:
    """Triangles of which no more than two meet at an edge, and then on its two sides."""

    def __init__(self, point: Float[ndarray, "node 3"]) -> None:
        self.faces: list[list[int]] = []
        self._point = point
        self._sides: dict[tuple[int, int], list[ndarray]] = {}

    def add(self, candidates: Int[ndarray, "face 3"], *, least: int) -> None:
        """Take in the triangles that fit and share at least some edges with those before."""
        for face in candidates.tolist():
            sides = [(edge, self._side(face, *edge)) for edge in combinations(face, 2)]
            pairs = [(self._sides.get(edge, []), side) for edge, side in sides]
            if sum(len(present) for present, _ in pairs) < least:
                continue
            if all(len(present) < 2 and _lies_beside(present, side) for present, side in pairs):
                self.faces.append(face)
                for edge, side in sides:
                    self._sides.setdefault(edge, []).append(side)

    def _side(self, face: list[int], start: int, end: int) -> Float[ndarray, " 3"]:
        """Find the direction from an edge of a triangle to its third corner."""
        (apex,) = set(face) - {start, end}
        along = self._point[end] - self._point[start]
        across = self._point[apex] - self._point[start]
        across = across - along * (across @ along) / max(float(along @ along), 1e-300)
        return across / max(float(np.linalg.norm(across)), 1e-300)


def _lies_beside(sides: list[ndarray], side: Float[ndarray, " 3"]) -> bool:
    """Whether two triangles lie on different sides of their common edge."""
    return all(float(other @ side) < _OVERLAP for other in sides)


def _tangent_triangles(
    point: Float[ndarray, "neighbor 3"],
    axes: Float[ndarray, "2 3"],
    number: Int[ndarray, " neighbor"],
    center: int,
) -> list[tuple[int, ...]]:
    """Triangulate a neighborhood in its plane and give the triangles that touch its center."""
    if len(number) < 3:
        return []
    try:
        corners = number[Delaunay((point - point.mean(axis=0)) @ axes.T).simplices]
    except QhullError:  # All neighbors lie on one line.
        return []
    return [tuple(sorted(map(int, c))) for c in corners if center in c]


def _oriented(faces: Int[ndarray, "face 3"]) -> Int[ndarray, "face 3"]:
    """Turn triangles so that neighbors run through their common edge in opposite directions."""
    of_edge: dict[tuple[int, int], list[int]] = {}
    for index, (a, b, c) in enumerate(faces.tolist()):
        for edge in ((a, b), (b, c), (a, c)):
            of_edge.setdefault(edge, []).append(index)
    turned = faces.copy()
    is_done = np.zeros(len(faces), dtype=bool)
    for start in range(len(faces)):
        waiting = [] if is_done[start] else [start]
        is_done[start] = True
        while waiting:
            corners = turned[waiting.pop()].tolist()
            for a, b in zip(corners, corners[1:] + corners[:1], strict=True):
                for other in of_edge[min(a, b), max(a, b)]:
                    if not is_done[other]:
                        is_done[other] = True
                        waiting.append(other)
                        if _runs(turned[other].tolist(), a, b):
                            turned[other] = turned[other][::-1]
    return turned.astype(np.int32)


def _runs(corners: list[int], a: int, b: int) -> bool:
    """Whether corner b follows corner a in a triangle."""
    return corners[(corners.index(a) + 1) % 3] == b


def _volume(point: Float[ndarray, "node 3"], largest: float) -> Int[ndarray, "face 3"]:
    """Take the faces of small tetrahedra that no other small tetrahedron shares."""
    try:
        tetrahedra = Delaunay(point).simplices.astype(np.int64)
    except QhullError:
        return np.zeros((0, 3), np.int32)
    tetrahedra = tetrahedra[_circumsphere(point[tetrahedra]) <= largest]
    opposite = np.concatenate([tetrahedra[:, i] for i in range(4)])
    faces = np.concatenate([np.delete(tetrahedra, i, axis=1) for i in range(4)])
    _, first, _, count = unique_rows(np.sort(faces, axis=1))
    first = first[count == 1]
    faces, opposite = faces[first], opposite[first]
    a, b, c = (point[faces[:, i]] for i in range(3))
    looks_in = np.sum(np.cross(b - a, c - a) * (point[opposite] - a), axis=1) > 0
    faces[looks_in] = faces[looks_in][:, ::-1]
    return faces.astype(np.int32)


def _circumradius(corner: Float[ndarray, "face 3 3"]) -> Float[ndarray, " face"]:
    """Measure the circle through the corners of each triangle [m]; infinite for a flat one."""
    a, b, c = (corner[:, i] for i in range(3))
    sides = [np.linalg.norm(x, axis=1) for x in (b - a, c - b, a - c)]
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    product = sides[0] * sides[1] * sides[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        radius = product / (4.0 * area)
    return np.where(np.isfinite(radius), radius, np.inf)


def _circumsphere(corner: Float[ndarray, "cell 4 3"]) -> Float[ndarray, " cell"]:
    """Measure the sphere through the corners of each tetrahedron [m]; infinite for a flat one."""
    edge = corner[:, 1:] - corner[:, :1]
    size = np.linalg.norm(edge, axis=2).max(axis=1)
    volume = np.abs(np.linalg.det(edge))
    is_flat = volume <= _FLATTEST * size**3
    edge[is_flat] = np.eye(3)
    half = 0.5 * np.sum(edge**2, axis=2)
    center = np.linalg.solve(edge, half[..., None])[..., 0]
    return np.where(is_flat, np.inf, np.linalg.norm(center, axis=1))
