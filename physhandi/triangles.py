"""Areas and normals of triangle meshes."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray


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


def _doubled_normals(
    vertex: Float[ndarray, "vertex 3"], faces: Int[ndarray, "face 3"]
) -> Float[ndarray, "face 3"]:
    """Give the normal of each triangle, twice as long as its area."""
    a, b, c = (vertex[faces[:, corner]].astype(np.float64) for corner in range(3))
    return np.cross(b - a, c - a)
