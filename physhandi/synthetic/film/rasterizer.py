"""Triangles drawn into depth and label images by a z-buffer of arrays."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from physhandi.data.camera import PinholeCamera

_NEAR = 0.05
_SAMPLES = 2_000_000


@dataclass(frozen=True, eq=False)
class Raster:
    """What each pixel sees of a mesh."""

    depth: Float[ndarray, "row column"]
    """Distance along the camera's z axis [m]; 0 where no triangle is."""
    face: Int[ndarray, "row column"]
    """Triangle that is seen; -1 where none is."""
    weight: Float[ndarray, "row column 3"]
    """Weights of the triangle's corners, on the surface rather than in the image."""

    def interpolate(
        self, faces: Int[ndarray, "face 3"], value: Float[ndarray, "vertex channel"]
    ) -> Float[ndarray, "row column channel"]:
        """Blend a quantity of the vertices at every pixel; 0 where no triangle is."""
        corner = value[faces[np.maximum(self.face, 0)]]
        blended = np.einsum("rck,rckd->rcd", self.weight, corner)
        return np.where(self.face[..., None] >= 0, blended, 0.0)


def rasterize(
    camera: PinholeCamera, vertex: Float[ndarray, "vertex 3"], faces: Int[ndarray, "face 3"]
) -> Raster:
    """Draw both sides of every triangle and keep the nearest one per pixel.

    The camera must be without distortion. Triangles that reach behind the camera are left out.

    Args:
        camera: Where the picture is taken from.
        vertex: Vertices in the world frame [m].
        faces: Vertices of each triangle.

    Returns:
        Depth, triangle and corner weights of every pixel.
    """
    local = camera.to_camera(vertex)
    pixel = np.full((len(vertex), 2), np.nan)
    front = local[:, 2] > _NEAR
    pixel[front] = camera.project(vertex[front])
    drawn = np.flatnonzero(front[faces].all(axis=1))
    corner = pixel[faces[drawn]]
    low = np.maximum(np.ceil(corner.min(axis=1)), 0).astype(np.int64)
    limit = np.array([camera.width - 1, camera.height - 1])
    high = np.minimum(np.floor(corner.max(axis=1)), limit).astype(np.int64)
    size = (high - low + 1).max(axis=1, initial=0)
    visible = (high >= low).all(axis=1)
    found: list[tuple[ndarray, ...]] = []
    step = 2
    while visible.any() and step < 2 * max(camera.width, camera.height):
        group = np.flatnonzero(visible & (size <= step) & (size > (step // 2 if step > 2 else 0)))
        chunk = max(_SAMPLES // (step * step), 1)
        for first in range(0, len(group), chunk):
            part = group[first : first + chunk]
            found.append(_cover(part, step, (corner, low, high), local[faces[drawn[part]], 2]))
        step *= 2
    return _resolve(camera, found, drawn)


def _cover(
    part: ndarray, step: int, outline: tuple[ndarray, ndarray, ndarray], depth: ndarray
) -> tuple[ndarray, ...]:
    """List the pixels that a group of similarly small triangles covers."""
    corner, low, high = outline
    offset = np.stack(np.meshgrid(np.arange(step), np.arange(step)), axis=-1).reshape(1, -1, 2)
    place = low[part, None] + offset
    a, b, c = (corner[part, number, None] for number in range(3))
    area = _cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = np.stack(
            [_cross(c - b, place - b), _cross(a - c, place - c), _cross(b - a, place - a)], axis=-1
        )
        flat = flat / area[..., None]
    inside = (flat >= 0).all(axis=-1) & (place <= high[part, None]).all(axis=-1)
    triangle, sample = np.nonzero(inside)
    per_depth = flat[triangle, sample] / depth[triangle]
    inverse = per_depth.sum(axis=1)
    return part[triangle], place[triangle, sample], inverse, per_depth / inverse[:, None]


def _resolve(camera: PinholeCamera, found: list[tuple[ndarray, ...]], drawn: ndarray) -> Raster:
    """Keep the nearest sample of every pixel; of equally near ones the last triangle's."""
    shape = (camera.height, camera.width)
    depth, face = np.zeros(shape), np.full(shape, -1, dtype=np.int64)
    weight = np.zeros((*shape, 3))
    if found:
        triangle, place, inverse, blend = (
            np.concatenate(column) for column in zip(*found, strict=True)
        )
        order = np.lexsort((triangle, inverse))
        rows, columns = place[order, 1], place[order, 0]
        depth[rows, columns] = 1.0 / inverse[order]
        face[rows, columns] = drawn[triangle[order]]
        weight[rows, columns] = blend[order]
    return Raster(depth, face, weight)


def _cross(first: ndarray, second: ndarray) -> ndarray:
    return first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]


def vertex_normals(
    vertex: Float[ndarray, "vertex 3"], faces: Int[ndarray, "face 3"]
) -> Float[ndarray, "vertex 3"]:
    """Average the normals of the triangles around each vertex, weighted by their area."""
    a, b, c = (vertex[faces[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    total = np.zeros_like(vertex)
    for corner in range(3):
        np.add.at(total, faces[:, corner], normal)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


def triangle_areas(
    vertex: Float[ndarray, "vertex 3"], faces: Int[ndarray, "face 3"]
) -> Float[ndarray, " face"]:
    """Measure each triangle [m²]."""
    a, b, c = (vertex[faces[:, corner]] for corner in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
