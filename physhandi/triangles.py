"""Areas, normals and distances of triangles."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

_FLAT = 1e-6
"""Sine of the widest angle of two edges at which a triangle counts as flat."""


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
