"""The smooth surface of an object, bound to its nodes: it moves with them in any rollout.

A sheet, a solid and a shell get the triangles that `triangulate_nodes` lays through their nodes,
subdivided by Loop's rule; a rope gets a tube round the curve through its nodes. Vertices of the
former are fixed affine combinations of nodes, those of a tube stand round such combinations, turned
without twist along the curve (rotation-minimizing frames).

Source: C. Loop, Smooth Subdivision Surfaces Based on Triangles, 1987, with J. Warren's weights and
the rules for borders and corners of H. Hoppe et al., Piecewise Smooth Surface Reconstruction, 1994.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray
from scipy.sparse import coo_array, csr_array, vstack
from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree
from scipy.spatial import KDTree
from scipy.spatial.distance import pdist, squareform

from physhandi.rotations import parallel_transport, smallest_rotations, unit
from physhandi.simulation.surface import is_line, triangulate_nodes, typical_distance
from physhandi.unique_rows import unique_rows

MOST_VERTICES = 4_500
"""A surface is subdivided while it has no more vertices than this: 54 kB of coordinates a frame."""
_CORNER = np.cos(np.deg2rad(115.0))
"""A border that turns more sharply than this at a node has a corner there."""
_TOUCHING = 3.0
"""Nodes of a rope hold together up to this many typical distances."""
_SMOOTHING = 1.2
"""Width of the kernel that averages a rope's nodes to its middle, in typical distances."""
_STATION = 0.7
"""Distance of the rings of a tube, in its radii."""
_SIDES = 12
"""Vertices of a ring."""
_SPARSE = 0.5
"""Nodes of a rope that is thinner than this part of their distance are on its middle."""
_THINNEST, _THICKEST = 0.2, 1.5
"""Least and largest radius of a tube, in typical distances of nodes."""
_ROUND_END = np.array([[0.87, 0.5], [0.5, 0.87]])
"""Rings of a tube's end: how far beyond the middle's last point, and how wide, in radii."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ObjectSurface:
    """Triangles whose corners follow the nodes of an object."""

    face: Int[ndarray, "face 3"]
    """Triangles: those of closed surfaces look outwards, of open ones upwards at rest."""
    weight: Any
    """Sparse matrix whose rows sum to 1: which nodes a vertex, or a ring of a tube, follows."""
    tube: "Tube | None" = None
    """How the vertices of a rope stand round its middle; None where there are no rings."""
    color: UInt8[ndarray, "vertex 3"] | None = None
    """Color of each vertex; None if no view has seen it."""

    @property
    def node_count(self) -> int:
        """Nodes of the object."""
        return int(self.weight.shape[1])

    @property
    def vertex_count(self) -> int:
        """Corners of the triangles."""
        rows = int(self.weight.shape[0])
        return rows if self.tube is None else _SIDES * (rows - 2) + 2

    def place(self, node: Float[ndarray, "node 3"]) -> Float[ndarray, "vertex 3"]:
        """Find where the vertices are when the nodes are somewhere [m]."""
        place: ndarray = self.weight @ np.asarray(node, np.float32)
        return place if self.tube is None else self.tube.inflate(place)

    def carry(self, value: Float[ndarray, " node"]) -> Float[ndarray, " vertex"]:
        """Give vertices the values of the nodes that they follow; NaN where none is known."""
        value = np.asarray(value, np.float32)
        is_known = np.isfinite(value)
        carried: ndarray = self.weight @ np.where(is_known, value, np.float32(0.0))
        if not is_known.all():
            share: ndarray = self.weight @ is_known.astype(np.float32)
            carried = np.where(share > 0.5, carried / np.maximum(share, 0.5), np.nan)
        if is_known.any():  # A rope's ends are beyond the values around them.
            carried = np.clip(carried, value[is_known].min(), value[is_known].max())
        if self.tube is None:
            return carried
        return np.concatenate([carried[:1], np.repeat(carried[1:-1], _SIDES), carried[-1:]])


@dataclass(frozen=True, eq=False, kw_only=True)
class Tube:
    """How vertices stand round a curve: a point, rings of `_SIDES`, and a point."""

    radius: float
    """Of the tube [m]."""
    start: Float[ndarray, "2 3"]
    """At rest, direction of the curve's start and one across it."""
    along: Float[ndarray, " ring"]
    """How far rings are shifted along the curve, in radii."""
    width: Float[ndarray, " ring"]
    """Radius of each ring, in radii of the tube; 0 for the points at both ends."""

    def inflate(self, middle: Float[ndarray, "ring 3"]) -> Float[ndarray, "vertex 3"]:
        """Place the vertices round the middles of their rings [m]."""
        curve = middle.astype(np.float64)
        ahead = self._directions(curve)
        across = parallel_transport(
            smallest_rotations(self.start[0], ahead[0]) @ self.start[1], ahead
        )
        other = np.cross(ahead, across)
        angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
        around = across[:, None] * np.cos(angle)[:, None] + other[:, None] * np.sin(angle)[:, None]
        center = curve + self.radius * self.along[:, None] * ahead
        ring = center[:, None] + self.radius * self.width[:, None, None] * around
        inner = ring[1:-1].reshape(-1, 3)
        return np.concatenate([ring[:1, 0], inner, ring[-1:, 0]]).astype(np.float32)

    def _directions(self, curve: Float[ndarray, "ring 3"]) -> Float[ndarray, "ring 3"]:
        """Find where the curve heads at each ring; the rings of an end share its last point."""
        count = len(_ROUND_END) + 1
        inner = curve[count:-count]
        ahead = unit(np.gradient(inner, axis=0))
        return np.concatenate([ahead[:1]] * count + [ahead] + [ahead[-1:]] * count)


def lay_surface(
    node: Float[ndarray, "node 3"],
    *,
    kind: str | None = None,
    thickness: float | None = None,
    most_vertices: int = MOST_VERTICES,
) -> ObjectSurface | None:
    """Lay a smooth surface through the nodes of an object.

    Args:
        node: Nodes at rest or in the first frame [m].
        kind: ``sheet``, ``solid``, ``shell`` or ``rope``; None to tell it by the nodes.
        thickness: How thick it is [m], which a rope needs; None to tell it by the nodes.
        most_vertices: The surface is not subdivided beyond this, unless it has more nodes.

    Returns:
        The surface; None where the nodes have none. It is shared by all who ask for the same.
    """
    point = np.asarray(node, np.float64)
    if len(point) < 4 or not np.isfinite(point).all():
        return None
    return _lay(point.tobytes(), kind, thickness, most_vertices)


@lru_cache(maxsize=8)
def _lay(
    nodes: bytes, kind: str | None, thickness: float | None, most_vertices: int
) -> ObjectSurface | None:
    """Lay the surface of nodes; kept, since each tab, picture and file of a run asks for it."""
    point = np.frombuffer(nodes).reshape(-1, 3)
    if kind == "rope" or (kind is None and is_line(point)):
        return _lay_tube(point, thickness, most_vertices)
    faces = triangulate_nodes(point, kind=kind)
    if len(faces) == 0:
        return None
    used, local = np.unique(faces, return_inverse=True)
    face = local.reshape(-1, 3)
    weight: Any = csr_array(
        (np.ones(len(used)), (np.arange(len(used)), used)), shape=(len(used), len(point))
    )
    is_corner = _corners(point[used], face)
    is_open = bool(_Edges(face).is_border.any())
    if _facing(point[used], face, is_open=is_open) < 0.0:
        face = face[:, ::-1]
    if not is_open:  # The outside of a body of cubes has steps.
        weight = _Edges(face).smoothing(weight.shape[0], is_corner) @ weight
    while True:
        edges = _Edges(face)
        count = weight.shape[0]
        if count + len(edges.pair) > most_vertices:
            break
        weight = edges.subdivision(count, is_corner) @ weight
        face = edges.quartered(face, count)
        is_corner = np.concatenate([is_corner, np.zeros(len(edges.pair), bool)])
    return ObjectSurface(face=face.astype(np.int32), weight=_rows(weight))


def _facing(
    point: Float[ndarray, "vertex 3"], face: Int[ndarray, "face 3"], *, is_open: bool
) -> float:
    """Add up how far triangles look up or, if they are closed, out, weighted by their area."""
    a, b, c = (point[face[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    out = (a + b + c) / 3 - point.mean(axis=0)
    return float(normal[:, 2].sum() if is_open else np.sum(normal * out))


def _rows(weight: Any) -> Any:
    """Keep a sparse matrix in the form in which it is applied fast."""
    return csr_array(weight).astype(np.float32)


class _Edges:
    """The edges of triangles, and Loop's rules for them.

    Attributes:
        pair: Both ends of each edge ``(edge, 2)``.
        is_border: Whether an edge is not between exactly two triangles.
    """

    def __init__(self, face: Int[ndarray, "face 3"]) -> None:
        ends = np.concatenate([face[:, [1, 2]], face[:, [2, 0]], face[:, [0, 1]]])
        self.pair, _, number, count = unique_rows(np.sort(ends, axis=1))
        self._of_face = number.reshape(3, -1).T
        self._opposite = face.T.ravel()
        self._number = number
        self.is_border = count != 2

    def subdivision(self, count: int, is_corner: Bool[ndarray, " vertex"]) -> Any:
        """Give the matrix from old vertices to old and new ones."""
        edge, is_border = len(self.pair), self.is_border
        new = np.arange(edge)
        share = np.where(is_border, 0.5, 0.375)
        inner = ~is_border[self._number]
        row = np.concatenate([new, new, self._number[inner]])
        column = np.concatenate([self.pair[:, 0], self.pair[:, 1], self._opposite[inner]])
        value = np.concatenate([share, share, np.full(int(inner.sum()), 0.125)])
        middle = coo_array((value, (row, column)), shape=(edge, count))
        return csr_array(vstack([self.smoothing(count, is_corner), middle]))

    def smoothing(self, count: int, is_corner: Bool[ndarray, " vertex"]) -> Any:
        """Give the matrix that moves old vertices: inner ones, borders along themselves."""
        a, b = self.pair.T
        rim = np.bincount(self.pair[self.is_border].ravel(), minlength=count)
        valence = np.bincount(self.pair.ravel(), minlength=count)
        is_inner = rim == 0
        share = np.where(valence == 3, 3.0 / 16.0, 3.0 / (8.0 * np.maximum(valence, 1)))
        share = np.where(is_inner, share, np.where((rim == 2) & ~is_corner, 0.125, 0.0))
        row, column = np.concatenate([a, b]), np.concatenate([b, a])
        counts = is_inner[row] | np.tile(self.is_border, 2)
        row, column = row[counts], column[counts]
        value = share[row]
        rest = 1.0 - np.bincount(row, weights=value, minlength=count)
        own = np.arange(count)
        return csr_array(
            (np.concatenate([value, rest]), (np.append(row, own), np.append(column, own))),
            shape=(count, count),
        )

    def quartered(self, face: Int[ndarray, "face 3"], count: int) -> Int[ndarray, "part 3"]:
        """Cut every triangle into four; the middle of edge e is vertex ``count + e``."""
        a, b, c = face.T
        bc, ca, ab = (count + self._of_face).T
        parts = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        return np.concatenate([np.stack(part, axis=1) for part in parts])


def _corners(
    point: Float[ndarray, "vertex 3"], face: Int[ndarray, "face 3"]
) -> Bool[ndarray, " vertex"]:
    """Find the vertices at which the border of a surface has a corner."""
    edges = _Edges(face)
    pair = edges.pair[edges.is_border]
    start, end = np.concatenate([pair, pair[:, ::-1]]).T
    order = np.argsort(start, kind="stable")
    start, end = start[order], end[order]
    is_corner = np.zeros(len(point), bool)
    vertex, first, count = np.unique(start, return_index=True, return_counts=True)
    first, vertex = first[count == 2], vertex[count == 2]
    arms = unit(point[np.stack([end[first], end[first + 1]], axis=1)] - point[vertex, None])
    is_corner[vertex] = np.sum(arms[:, 0] * arms[:, 1], axis=1) > _CORNER
    return is_corner


def _lay_tube(
    point: Float[ndarray, "node 3"], thickness: float | None, most_vertices: int
) -> ObjectSurface | None:
    """Lay a tube round nodes that follow one open curve; None if they do not."""
    pitch = typical_distance(point)
    if thickness is not None and thickness < pitch:
        thin = _lay_thin_tube(point, 0.5 * thickness, most_vertices)
        if thin is not None:
            return thin
    place = _places_along(point, _TOUCHING * pitch)
    if place is None:
        return None
    width = _SMOOTHING * pitch
    on_curve = _kernel(place, place, width) @ point
    aside = np.linalg.norm(point - on_curve, axis=1)
    if aside.max() > _TOUCHING * pitch:  # A ring, or a knot: no single curve follows it.
        return None
    radius = 0.5 * thickness if thickness is not None else float(np.sqrt(2 * np.mean(aside**2)))
    radius = float(np.clip(radius, _THINNEST * pitch, _THICKEST * pitch))
    at = _stations(place, radius, most_vertices)
    return _tube_round(_kernel(at, place, width), point, radius)


def _lay_thin_tube(
    point: Float[ndarray, "node 3"], radius: float, most_vertices: int
) -> ObjectSurface | None:
    """Lay a tube round the spline through nodes that are farther apart than a rope is thick.

    They are on its middle, and an average over neighbors would cut every bend. None if they are no
    chain of such nodes.
    """
    from scipy.interpolate import CubicSpline

    tree = minimum_spanning_tree(squareform(pdist(point)))
    joints = np.bincount(np.concatenate(tree.nonzero()), minlength=len(point))
    if joints.max() > 2 or 2.0 * radius > _SPARSE * np.median(tree.data):
        return None
    place = np.asarray(dijkstra(tree, directed=False, indices=int(np.argmin(joints))))
    order = np.argsort(place)
    spline = CubicSpline(place[order], np.eye(len(place))[order])
    return _tube_round(spline(_stations(place, radius, most_vertices)), point, radius)


def _stations(
    place: Float[ndarray, " node"], radius: float, most_vertices: int
) -> Float[ndarray, " station"]:
    """Place the rings of a tube along a rope [m]."""
    most = max(most_vertices // _SIDES - 2 * (len(_ROUND_END) + 1), 4)
    count = int(np.clip(place.max() / (_STATION * radius), 4, most))
    return np.linspace(0.0, place.max(), count)


def _tube_round(
    station: Float[ndarray, "station node"], point: Float[ndarray, "node 3"], radius: float
) -> ObjectSurface:
    """Lay rings round the points of a rope's middle, and a round end at both of its ends."""
    ends, count = len(_ROUND_END) + 1, len(station)
    ring = np.concatenate([np.zeros(ends, int), np.arange(count), np.full(ends, count - 1)])
    beyond, wide = np.concatenate([[[1.0, 0.0]], _ROUND_END]).T
    along = np.concatenate([-beyond, np.zeros(count), beyond[::-1]])
    shape = np.concatenate([wide, np.ones(count), wide[::-1]])
    direction = unit(station[1] @ point - station[0] @ point)
    across = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    across /= np.linalg.norm(across)
    return ObjectSurface(
        face=_tube_faces(len(ring) - 2),
        weight=_rows(csr_array(station[ring])),
        tube=Tube(radius=radius, start=np.stack([direction, across]), along=along, width=shape),
    )


def _places_along(point: Float[ndarray, "node 3"], reach: float) -> Float[ndarray, " node"] | None:
    """Measure how far along a rope nodes are from one of its ends [m]; None if it is torn."""
    tree: Any = KDTree(point)
    graph = tree.sparse_distance_matrix(tree, reach, output_type="coo_matrix").tocsr()
    end = int(np.argmax(dijkstra(graph, indices=0)))
    place = np.asarray(dijkstra(graph, indices=end))
    return place if np.isfinite(place).all() else None


def _kernel(
    at: Float[ndarray, " station"], place: Float[ndarray, " node"], width: float
) -> Float[ndarray, "station node"]:
    """Give the weights of a local linear regression: rows sum to 1, and straight lines stay."""
    offset = place - at[:, None]
    bell = np.exp(-0.5 * (offset / width) ** 2)
    bell[bell < 1e-3] = 0.0
    s0, s1, s2 = (np.sum(bell * offset**power, axis=1) for power in range(3))
    spread = np.maximum(s0 * s2 - s1**2, 1e-9 * s0 * width**2)
    weight = bell * (s2[:, None] - offset * s1[:, None]) / spread[:, None]
    return weight / weight.sum(axis=1, keepdims=True)


def _tube_faces(rings: int) -> Int[ndarray, "face 3"]:
    """Join a point, rings and a point by triangles that look outwards."""
    side = np.arange(_SIDES)
    after = (side + 1) % _SIDES
    first = 1 + _SIDES * np.arange(rings - 1)[:, None]
    a, b = first + side, first + after
    c, d = a + _SIDES, b + _SIDES
    last = 1 + _SIDES * (rings - 1)
    start, end = np.zeros(_SIDES, int), np.full(_SIDES, last + _SIDES)
    parts = [
        np.stack([a, b, d], axis=-1).reshape(-1, 3),
        np.stack([a, d, c], axis=-1).reshape(-1, 3),
        np.stack([start, 1 + after, 1 + side], axis=1),
        np.stack([end, last + side, last + after], axis=1),
    ]
    return np.concatenate(parts).astype(np.int32)
