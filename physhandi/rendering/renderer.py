"""Draws shapes: what the centre of every pixel sees, or an antialiased picture."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from physhandi.data.camera import PinholeCamera
from physhandi.devices import start_warp
from physhandi.rendering.kernels import (
    NOTHING,
    Grid,
    Shapes,
    color_pixels,
    cover_balls,
    cover_triangles,
    describe_samples,
)
from physhandi.rendering.projection import Projection, project
from physhandi.rendering.shapes import Shape

NEAR = 1e-3
"""What is nearer to the camera is not seen, unless a caller says otherwise."""
FROM_ABOVE = np.array([0.0, 0.0, 1.0])
"""Light straight from above."""
_STRIP = 2**19
"""Samples that are held at once."""
_BAND = 32
"""Rows of samples that a thread of a graphics card takes; a processor takes all."""
_GRID: Any = Grid
_SHAPES: Any = Shapes
_BYTE: Any = wp.uint8
_KEY: Any = wp.int64
_COLOR: Any = wp.vec4ub


@dataclass(frozen=True, eq=False)
class Raster:
    """Nearest shape at the centre of each pixel."""

    depth: Float[ndarray, "row column"]
    """Distance along the camera's z axis [m]; 0 where nothing is."""
    shape: Int[ndarray, "row column"]
    """Number of the shape; -1 where nothing is."""
    element: Int[ndarray, "row column"]
    """Triangle, ball or segment of that shape; -1 where nothing is."""
    weight: Float[ndarray, "row column 3"]
    """Weights of a triangle's corners, on the surface rather than in the picture."""

    def interpolate(
        self, faces: Int[ndarray, "face 3"], value: Float[ndarray, "vertex channel"]
    ) -> Float[ndarray, "row column channel"]:
        """Blend a quantity of the vertices of the only surface; 0 where nothing is."""
        blended = np.zeros((*self.element.shape, value.shape[1]))
        seen = self.element >= 0
        corner = value[faces[self.element[seen]]]
        blended[seen] = np.einsum("pc,pcd->pd", self.weight[seen], corner)
        return blended


def rasterize(
    camera: PinholeCamera, shapes: Sequence[Shape], *, near: float = NEAR, device: str = "cpu"
) -> Raster:
    """Find what the centre of every pixel sees; sheer surfaces count as solid ones.

    Of equally near shapes the first one is seen, but surfaces before balls.

    Args:
        camera: Where the picture is taken from.
        shapes: What there is.
        near: Least depth that is seen.
        device: Warp device.

    Raises:
        ValueError: If the camera has distortion.
    """
    projection = project(camera, shapes, near=near)
    left, top, right, bottom = projection.window
    size = (bottom - top, right - left)
    scene = _DeviceScene(projection, near, device, size)
    depth = wp.zeros(size, dtype=wp.float64, device=scene.device)
    number = wp.full(size, -1, dtype=wp.int32, device=scene.device)
    weight = wp.zeros(size, dtype=wp.vec3d, device=scene.device)
    wp.launch(
        describe_samples,
        size,
        [scene.shapes, scene.grid(top, bottom), scene.cover(top, bottom)[0]],
        [depth, number, weight],
        device=scene.device,
    )
    raster = Raster(
        depth=np.zeros((camera.height, camera.width)),
        shape=np.full((camera.height, camera.width), -1, np.int32),
        element=np.full((camera.height, camera.width), -1, np.int32),
        weight=np.zeros((camera.height, camera.width, 3)),
    )
    triangles, balls = projection.triangles, projection.balls
    seen: ndarray = number.numpy()
    place = np.s_[top:bottom, left:right]
    raster.depth[place], raster.weight[place] = depth.numpy(), weight.numpy()
    raster.shape[place] = np.concatenate([triangles.shape, balls.shape, [-1]])[seen]
    raster.element[place] = np.concatenate([triangles.element, balls.element, [-1]])[seen]
    return raster


def render(
    camera: PinholeCamera,
    shapes: Sequence[Shape],
    *,
    background: tuple[int, int, int] | None = None,
    light: Float[ndarray, " 3"] = FROM_ABOVE,
    samples: int = 2,
    near: float = NEAR,
    device: str = "cpu",
) -> UInt8[ndarray, "row column 4"]:
    """Draw an antialiased picture.

    Args:
        camera: Where the picture is taken from.
        shapes: What there is; sheer surfaces let through what is behind them.
        background: Color behind everything; none leaves it clear.
        light: Direction from which the light comes, in the world.
        samples: Each pixel is averaged over this many rows and columns.
        near: Least depth that is seen.
        device: Warp device.

    Returns:
        Red, green, blue and opacity.

    Raises:
        ValueError: If the camera has distortion.
    """
    towards = light / np.linalg.norm(light)
    projection = project(camera, shapes, near=near, samples=samples, light=towards)
    ground = (0, 0, 0, 0) if background is None else (*background, 255)
    image = np.empty((camera.height, camera.width, 4), np.uint8)
    image[:] = ground
    left, top, right, bottom = projection.window
    row_size = max(len(projection.opacity) * samples * samples * (right - left), 1)
    step = max(_STRIP // row_size, 1)
    size = (samples * min(step, bottom - top), samples * (right - left))
    scene = _DeviceScene(projection, near, device, size)
    for first in range(top, bottom, step):
        end = min(first + step, bottom)
        part = wp.empty((end - first, right - left, 4), dtype=_BYTE, device=scene.device)
        rows = (samples * first, samples * end)
        wp.launch(
            color_pixels,
            part.shape[:2],
            [
                *(scene.shapes, scene.grid(*rows), scene.cover(*rows)),
                *(scene.opacity, samples, _COLOR(*ground)),
            ],
            [part],
            device=scene.device,
        )
        image[first:end, left:right] = part.numpy()
    return image


class _DeviceScene:
    """A projection on a device."""

    def __init__(
        self, projection: Projection, near: float, device: str, size: tuple[int, int]
    ) -> None:
        """Place a projection on a device.

        Args:
            projection: What there is.
            near: Least depth that is seen.
            device: Warp device.
            size: Rows that are covered at once, and columns of samples in the window.
        """
        start_warp()
        self.device: Any = wp.get_device(device)
        self._layers = list(pairwise([0, *projection.layer_end]))
        self._key = wp.empty((len(self._layers), *size), dtype=_KEY, device=self.device)
        self._grid = _GRID()
        self._grid.K = wp.mat33d(*projection.K.ravel())
        self._grid.inverse = wp.mat33d(*np.linalg.inv(projection.K).ravel())
        self._grid.near = near
        self._grid.left = projection.window[0] * projection.samples
        self._grid.right = projection.window[2] * projection.samples
        triangles, balls = projection.triangles, projection.balls
        self.opacity = self._array(np.array(projection.opacity), wp.float32)
        self.shapes = _SHAPES()
        self.shapes.corner = self._array(triangles.corner, wp.vec3d)
        self.shapes.corner_color = self._array(triangles.color, wp.vec3)
        self.shapes.image = self._array(triangles.image, wp.vec3i)
        self.shapes.texel = self._array(projection.texel, wp.vec3ub)
        self.shapes.center = self._array(balls.center, wp.vec3d)
        self.shapes.radius = self._array(balls.radius, wp.float64)
        self.shapes.ball_color = self._array(balls.color, wp.vec3)
        self.shapes.ball_shading = self._array(balls.shading, wp.float32)
        self.shapes.light = wp.vec3d(*projection.light)

    def grid(self, top: int, bottom: int) -> Any:
        """Describe rows of samples in the window."""
        self._grid.top, self._grid.bottom = top, bottom
        return self._grid

    def cover(self, top: int, bottom: int) -> Any:
        """Find the nearest shape of every layer at every sample of some rows.

        The array is used again for the next rows.
        """
        self._key.fill_(wp.int64(NOTHING))
        band = _BAND if self.device.is_cuda else bottom - top
        band_count = -(-(bottom - top) // band)
        grid, shapes = self.grid(top, bottom), self.shapes
        for layer, (first, end) in enumerate(self._layers):
            if end > first:
                wp.launch(
                    cover_triangles,
                    (end - first, band_count),
                    [shapes.corner[first:end], first, grid, band],
                    [self._key[layer]],
                    device=self.device,
                )
        if len(shapes.center):
            wp.launch(
                cover_balls,
                (len(shapes.center), band_count),
                [shapes.center, shapes.radius, len(shapes.corner), grid, band],
                [self._key[0]],
                device=self.device,
            )
        return self._key

    def _array(self, value: ndarray, dtype: Any) -> Any:
        return wp.array(np.ascontiguousarray(value), dtype=dtype, device=self.device)
