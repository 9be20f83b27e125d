"""Shapes as a camera sees them: triangles and balls in its axes."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import product
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from physhandi.data.camera import PinholeCamera
from physhandi.rendering.shapes import Balls, Image, Segments, Shape, Surface
from physhandi.triangles import vertex_normals

_IMAGE_PLACE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
_QUAD = np.array([[0, 1, 2], [0, 2, 3]])
_Rows = TypeVar("_Rows")


@dataclass(frozen=True, eq=False)
class ProjectedTriangles:
    """Triangles of surfaces, segments and images."""

    corner: Float[ndarray, "triangle 3 3"]
    """Sample x times depth, sample y times depth, and depth."""
    color: Float[ndarray, "triangle 3 3"]
    """At the corners; on images the place in the image, from 0 to 1."""
    image: Int[ndarray, "triangle 3"]
    """First texel, columns and rows of the image on it; no columns where none is."""
    shape: Int[ndarray, " triangle"]
    """Number of the shape."""
    element: Int[ndarray, " triangle"]
    """Triangle or segment of the shape."""


@dataclass(frozen=True, eq=False)
class ProjectedBalls:
    """Balls of all shapes."""

    center: Float[ndarray, "ball 3"]
    """Middles in the camera's axes."""
    radius: Float[ndarray, " ball"]
    """Radii."""
    color: Float[ndarray, "ball 3"]
    """Colors."""
    shading: Float[ndarray, " ball"]
    """How much darker the side away from the light is."""
    shape: Int[ndarray, " ball"]
    """Number of the shape."""
    element: Int[ndarray, " ball"]
    """Ball of the shape."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Projection:
    """All shapes before a camera."""

    K: Float[ndarray, "3 3"]
    """Camera matrix of the samples, whose centres have whole coordinates."""
    triangles: ProjectedTriangles
    """Those of solid shapes, then those of sheer ones."""
    balls: ProjectedBalls
    """All balls."""
    layer_end: list[int]
    """Triangle after the last one of all solid shapes, then of each sheer one."""
    opacity: list[float]
    """Of each of these layers."""
    texel: UInt8[ndarray, "texel 3"]
    """Pixels of all images."""
    light: Float[ndarray, " 3"]
    """Direction from which the light comes, in the camera's axes."""
    samples: int
    """Rows and columns of samples in a pixel."""
    window: tuple[int, int, int, int]
    """First column and row that shapes may reach, and the ones after the last; at least a pixel."""


def project(
    camera: PinholeCamera,
    shapes: Sequence[Shape],
    *,
    near: float,
    samples: int = 1,
    light: Float[ndarray, " 3"] | None = None,
) -> Projection:
    """Find where shapes are among the samples of a picture.

    Args:
        camera: Where they are seen from.
        shapes: What there is.
        near: Segments are cut off here.
        samples: Rows and columns of samples in a pixel.
        light: Direction of the light in the world; without it nothing is shaded or sheer.

    Raises:
        ValueError: If the camera has distortion.
    """
    if camera.distortion.any():
        raise ValueError("the camera must have no lens distortion; undistort what it recorded")
    view = _View(camera, samples, near)
    solid = [_rows(-1, np.zeros((0, 3, 3)), np.zeros((0, 3, 3)))]
    sheer: list[ProjectedTriangles] = []
    balls = [_balls(view, -1, Balls(center=np.zeros((0, 3)), radius=np.zeros(0)))]
    opacity, texel = [1.0], [np.zeros((0, 3), np.uint8)]
    for number, shape in enumerate(shapes):
        if isinstance(shape, Balls):
            balls.append(_balls(view, number, shape))
        elif isinstance(shape, Segments):
            solid.append(_segments(view, number, shape))
        elif isinstance(shape, Image):
            solid.append(_image(view, number, shape, sum(map(len, texel))))
            texel.append(shape.image.reshape(-1, 3))
        elif shape.opacity < 1 and light is not None:
            sheer.append(_surface(view, number, shape, light))
            opacity.append(shape.opacity)
        else:
            solid.append(_surface(view, number, shape, light))
    ends = np.cumsum([len(part.element) for part in [*solid, *sheer]])
    triangles, all_balls = _joined([*solid, *sheer]), _joined(balls)
    return Projection(
        K=view.K,
        triangles=triangles,
        balls=all_balls,
        layer_end=ends[len(solid) - 1 :].tolist(),
        opacity=opacity,
        texel=np.concatenate(texel),
        light=np.zeros(3) if light is None else light @ camera.T_world_camera[:3, :3],
        samples=samples,
        window=_window(view, triangles, all_balls),
    )


def _joined(parts: Sequence[_Rows]) -> _Rows:
    """Put the rows of several parts after each other."""
    kind: Any = type(parts[0])
    names = [field.name for field in fields(kind)]
    return kind(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


class _View:
    """A camera whose pixels are divided into samples."""

    def __init__(self, camera: PinholeCamera, samples: int, near: float) -> None:
        self.camera, self.samples, self.near = camera, samples, near
        self.K = camera.K.copy()
        self.K[:2] *= samples
        self.K[:2, 2] += (samples - 1) / 2

    def corners(self, point: Float[ndarray, "*batch 3"]) -> Float[ndarray, "*batch 3"]:
        """Give sample x times depth, sample y times depth, and depth of points in the world."""
        return self.camera.to_camera(np.asarray(point, np.float64)) @ self.K.T


def _window(
    view: _View, triangles: ProjectedTriangles, balls: ProjectedBalls
) -> tuple[int, int, int, int]:
    """Find the part of the picture that shapes may reach [px]."""
    size = np.array([view.camera.width, view.camera.height])
    corner = triangles.corner.reshape(-1, 3)
    # The corners of a box around each ball, but for those too near to be seen.
    seen = balls.center[:, 2] - balls.radius > view.near
    steps = np.array(list(product([-1.0, 1.0], repeat=3)))
    box = balls.center[seen, None] + balls.radius[seen, None, None] * steps
    point = np.concatenate([corner, (box @ view.K.T).reshape(-1, 3)])
    if not len(point):
        return 0, 0, 1, 1
    if not (point[:, 2] >= view.near).all():
        return 0, 0, *size.tolist()
    pixel = point[:, :2] / point[:, 2:] / view.samples
    low = np.clip(np.floor(pixel.min(axis=0)) - 1, 0, size - 1).astype(int)
    high = np.clip(np.ceil(pixel.max(axis=0)) + 2, low + 1, size).astype(int)
    return *low.tolist(), *high.tolist()


def _rows(
    number: int,
    corner: Float[ndarray, "triangle 3 3"],
    color: Float[ndarray, "triangle 3 3"],
    *,
    element: Int[ndarray, " triangle"] | None = None,
    image: tuple[int, int, int] = (0, 0, 0),
) -> ProjectedTriangles:
    """Describe triangles, but those that are not finite."""
    is_finite = np.isfinite(corner).all(axis=(1, 2))
    element = np.arange(len(corner)) if element is None else element
    count = int(is_finite.sum())
    return ProjectedTriangles(
        corner=corner[is_finite],
        color=color[is_finite],
        image=np.tile(np.array(image, np.int32), (count, 1)),
        shape=np.full(count, number, np.int32),
        element=element[is_finite].astype(np.int32),
    )


def _surface(
    view: _View, number: int, surface: Surface, light: Float[ndarray, " 3"] | None
) -> ProjectedTriangles:
    color = np.broadcast_to(surface.color, surface.vertex.shape)
    if light is not None and surface.shading > 0:
        facing = vertex_normals(surface.vertex, surface.faces) @ light
        color = color * (1.0 - 0.5 * surface.shading * (1.0 - facing))[:, None]
    corner = view.corners(surface.vertex)[surface.faces]
    return _rows(number, corner, color[surface.faces])


def _segments(view: _View, number: int, segments: Segments) -> ProjectedTriangles:
    """Lay a band along each segment, so far before it as a wire would reach."""
    ends = view.corners(segments.ends)
    depth = ends[..., 2]
    element = np.flatnonzero(np.isfinite(ends).all(axis=(1, 2)) & (depth > view.near).any(axis=1))
    ends, depth = ends[element], depth[element]
    # Of what crosses the near plane, the hidden end moves there.
    span = depth[:, ::-1] - depth
    share = (view.near - depth) / np.where(span == 0, 1.0, span)
    cut = ends + share[..., None] * (ends[:, ::-1] - ends)
    ends = np.where((depth < view.near)[..., None], cut, ends)
    pixel = ends[..., :2] / ends[..., 2:]
    along = pixel[:, 1] - pixel[:, 0]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    half = 0.5 * view.samples * segments.width
    across = half * np.stack([-along[:, 1], along[:, 0]], axis=-1)[:, None]
    sides = np.concatenate([pixel + across, (pixel - across)[:, ::-1]], axis=1)
    depth = ends[:, [0, 1, 1, 0], 2:] * max(1.0 - half / float(view.K[0, 0]), 0.5)
    corner = np.concatenate([sides * depth, depth], axis=-1)[:, _QUAD].reshape(-1, 3, 3)
    color = np.broadcast_to(segments.color, (len(segments.ends), 3))[element]
    color = np.repeat(color, 6, axis=0).reshape(-1, 3, 3)
    return _rows(number, corner, color, element=np.repeat(element, 2))


def _image(view: _View, number: int, image: Image, first: int) -> ProjectedTriangles:
    corner = view.corners(image.corner)[_QUAD]
    rows, columns = image.image.shape[:2]
    return _rows(number, corner, _IMAGE_PLACE[_QUAD], image=(first, columns, rows))


def _balls(view: _View, number: int, balls: Balls) -> ProjectedBalls:
    count = len(balls.center)
    radius = np.broadcast_to(np.asarray(balls.radius, np.float64), (count,))
    element = np.flatnonzero(np.isfinite(balls.center).all(axis=1) & np.isfinite(radius))
    return ProjectedBalls(
        center=view.camera.to_camera(balls.center[element].astype(np.float64)),
        radius=radius[element],
        color=np.broadcast_to(balls.color, (count, 3))[element],
        shading=np.full(len(element), balls.shading),
        shape=np.full(len(element), number, np.int32),
        element=element.astype(np.int32),
    )
