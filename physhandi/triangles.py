"""Areas, normals and distances of triangles, and samples of the surfaces that they make."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

_FLAT = 1e-6
"""Sine of the widest angle of two edges at which a triangle counts as flat."""
_OPEN = 0.1
"""Part of edges with one triangle only from which a mesh is open."""
_AT_ONCE = 256
"""Points whose winding numbers are found at once, so that memory stays small."""


def vertex_normals(
    vertex: Float[ndarray, "vertex 3"], faces: Int[ndarray, "face 3"]
) -> Float[ndarray, "vertex 3"]:
    """Average the normals of the triangles around each vertex, weighted by their area.

    A vertex without a triangle, or with flat ones only, has the normal zero.
    """
    normal = _doubled_normals(vertex, faces)
    total = np.zeros(vertex.shape)
    for axis in range(3):
        around = np.repeat(normal[:, axis], 3)
        total[:, axis] = np.bincount(faces.ravel(), weights=around, minlength=len(vertex))
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


def unit_normals(
    vertex: Float[ndarray, "vertex 3"], faces: Int[ndarray, "face 3"]
) -> Float[ndarray, "vertex 3"]:
    """Give each vertex a normal of length 1, as files want it: upwards where there is none else."""
    normal = vertex_normals(vertex, faces)
    return np.where(normal.any(axis=1, keepdims=True), normal, [0, 0, 1.0]).astype(np.float32)


def triangle_areas(
    vertex: Float[ndarray, "vertex 3"], faces: Int[ndarray, "face 3"]
) -> Float[ndarray, " face"]:
    """Measure each triangle [m²]."""
    return np.linalg.norm(_doubled_normals(vertex, faces), axis=1) / 2


def triangle_distance(
    point: Float[ndarray, "*item 3"], triangle: Float[ndarray, "*item 3 3"]
) -> Float[ndarray, "*item"]:
    """Measure how far each point is from a triangle of its own; a flat one is its edges [m]."""
    corner = [triangle[..., k, :] for k in range(3)]
    edge = [corner[(k + 1) % 3] - corner[k] for k in range(3)]
    offset = [point - corner[k] for k in range(3)]
    normal = np.cross(edge[0], edge[1])
    size = np.linalg.norm(normal, axis=-1)
    height = np.abs(_dot(offset[0], normal)) / np.maximum(size, 1e-300)
    # A triangle without area has no inside, but every sign below is zero.
    is_inside = size > _FLAT * np.sqrt(_dot(edge[0], edge[0]) * _dot(edge[1], edge[1]))
    nearest = np.full(height.shape, np.inf)
    for e, o in zip(edge, offset, strict=True):
        is_inside &= _dot(np.cross(normal, e), o) >= 0.0
        nearest = np.minimum(nearest, _offset_from_edge(o, e))
    return np.where(is_inside, height, nearest)


def segment_distance(
    point: Float[ndarray, "*item 3"],
    start: Float[ndarray, "*item 3"],
    end: Float[ndarray, "*item 3"],
) -> Float[ndarray, "*item"]:
    """Measure how far each point is from a straight segment of its own [m]."""
    return _offset_from_edge(point - start, end - start)


def _offset_from_edge(offset: ndarray, edge: ndarray) -> ndarray:
    along = np.clip(_dot(offset, edge) / np.maximum(_dot(edge, edge), 1e-300), 0.0, 1.0)
    return np.linalg.norm(offset - along[..., None] * edge, axis=-1)


def _dot(first: ndarray, second: ndarray) -> ndarray:
    return np.einsum("...d,...d->...", first, second)


def _doubled_normals(
    vertex: Float[ndarray, "vertex 3"], faces: Int[ndarray, "face 3"]
) -> Float[ndarray, "face 3"]:
    """Give the normal of each triangle, twice as long as its area."""
    a, b, c = (vertex[faces[:, corner]].astype(np.float64) for corner in range(3))
    return np.cross(b - a, c - a)


def is_closed(faces: Int[ndarray, "face 3"]) -> bool:
    """Whether nearly all edges of a mesh join two triangles, so that it has an inside."""
    edge = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    count = np.unique(edge, axis=0, return_counts=True)[1]
    return bool((count == 1).mean() < _OPEN)


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points spread over a surface, each of which stands for the same area."""

    point: Float[ndarray, "sample 3"]
    """Where they are [m]."""
    normal: Float[ndarray, "sample 3"]
    """Normals of their triangles, outwards if these are seen from outside."""
    area: float
    """Area that each stands for [m²]."""

    @property
    def thickness(self) -> float:
        """Mean thickness of what a closed surface encloses: twice its volume by its area [m]."""
        volume = float((self.point * self.normal).sum()) * self.area / 3.0
        return 2.0 * abs(volume) / (self.area * len(self.point))

    def winding_number(self, point: Float[ndarray, "point 3"]) -> Float[ndarray, " point"]:
        """Measure how often the surface goes around each point: 1 inside, 0 outside.

        Holes and overlaps of a surface change it little (Barill et al., "Fast winding numbers for
        soups and clouds", 2018). Nearer to the surface than samples are to each other it means
        nothing.
        """
        number = np.zeros(len(point))
        own, size = (self.point * self.normal).sum(axis=1), (self.point**2).sum(axis=1)
        for start in range(0, len(point), _AT_ONCE):
            part = point[start : start + _AT_ONCE]
            across = own - part @ self.normal.T
            square = size - 2.0 * part @ self.point.T + (part**2).sum(axis=1)[:, None]
            square = np.maximum(square, 1e-12)
            number[start : start + _AT_ONCE] = (across / (square * np.sqrt(square))).sum(axis=1)
        return number * self.area / (4.0 * np.pi)


def sample_surface(
    vertex: Float[ndarray, "vertex 3"], faces: Int[ndarray, "face 3"], count: int
) -> SurfaceSamples:
    """Spread points over triangles at random, evenly by area; the same for the same triangles."""
    doubled = _doubled_normals(vertex, faces)
    area = np.linalg.norm(doubled, axis=1) / 2
    random = np.random.default_rng(0)
    # One draw in each of equal parts of the area lies more evenly than draws from all of it.
    place = (np.arange(count) + random.random(count)) / count * area.sum()
    owner = np.minimum(np.searchsorted(np.cumsum(area), place), len(faces) - 1)
    first, second = np.sqrt(random.random(count)), random.random(count)
    weight = np.stack([1 - first, first * (1 - second), first * second], axis=1)
    corner = vertex[faces[owner]].astype(np.float64)
    return SurfaceSamples(
        point=np.einsum("sk,ski->si", weight, corner),
        normal=doubled[owner] / np.maximum(2 * area[owner, None], 1e-30),
        area=float(area.sum()) / count,
    )
