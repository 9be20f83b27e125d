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
_STRIP = 2**21
"""Samples that are held at once."""
_BAND = 32
"""Rows of samples that a thread of a graphics card takes; a processor takes all."""
_GRID: Any = Grid
_BYTE: Any = wp.uint8


@dataclass(frozen=True, eq=False)
class Raster:
    """What the centre of each pixel sees."""

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
    scene = _DeviceScene(projection, near, camera.width, device)
    size = (camera.height, camera.width)
    key = scene.cover(0, camera.height)
    depth = wp.zeros(size, dtype=wp.float64, device=scene.device)
    number = wp.full(size, -1, dtype=wp.int32, device=scene.device)
    weight = wp.zeros(size, dtype=wp.vec3d, device=scene.device)
    wp.launch(
        describe_samples,
        size,
        [scene.corner, scene.center, scene.radius, scene.grid(0, camera.height), key[0]],
        [depth, number, weight],
        device=scene.device,
    )
    triangles, balls = projection.triangles, projection.balls
    seen: ndarray = number.numpy()
    return Raster(
        depth=depth.numpy(),
        shape=np.concatenate([triangles.shape, balls.shape, [-1]])[seen],
        element=np.concatenate([triangles.element, balls.element, [-1]])[seen],
        weight=weight.numpy(),
    )


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
    scene = _DeviceScene(projection, near, samples * camera.width, device)
    ground = (0.0, 0.0, 0.0, 0.0) if background is None else (*background, 1.0)
    image = np.empty((camera.height, camera.width, 4), np.uint8)
    step = max(_STRIP // (len(projection.opacity) * scene.width * samples), 1)
    for top in range(0, camera.height, step):
        end = min(top + step, camera.height)
        part = wp.empty((end - top, camera.width, 4), dtype=_BYTE, device=scene.device)
        wp.launch(
            color_pixels,
            part.shape[:2],
            [
                *(scene.corner, scene.color, scene.image, scene.texel),
                *(scene.center, scene.radius, scene.ball_color, scene.ball_shading),
                wp.vec3d(*(towards @ camera.T_world_camera[:3, :3])),
                scene.grid(samples * top, samples * end),
                scene.cover(samples * top, samples * end),
                *(scene.opacity, samples, wp.vec4(*ground)),
            ],
            [part],
            device=scene.device,
        )
        image[top:end] = part.numpy()
    return image


class _DeviceScene:
    """A projection on a device."""

    def __init__(self, projection: Projection, near: float, width: int, device: str) -> None:
        start_warp()
        self.device: Any = wp.get_device(device)
        self.width = width
        self._K, self._near = projection.K, near
        self._layers = list(pairwise([0, *projection.layer_end]))
        triangles, balls = projection.triangles, projection.balls
        self.corner = self._array(triangles.corner, wp.vec3d)
        self.color = self._array(triangles.color, wp.vec3)
        self.image = self._array(triangles.image, wp.vec3i)
        self.texel = self._array(projection.texel, wp.vec3ub)
        self.opacity = self._array(np.array(projection.opacity), wp.float32)
        self.center = self._array(balls.center, wp.vec3d)
        self.radius = self._array(balls.radius, wp.float64)
        self.ball_color = self._array(balls.color, wp.vec3)
        self.ball_shading = self._array(balls.shading, wp.float32)

    def grid(self, first: int, end: int) -> Any:
        """Describe rows of samples."""
        grid = _GRID()
        grid.K, grid.inverse = (
            wp.mat33d(*self._K.ravel()),
            wp.mat33d(*np.linalg.inv(self._K).ravel()),
        )
        grid.near, grid.width, grid.first, grid.end = self._near, self.width, first, end
        return grid

    def cover(self, first: int, end: int) -> Any:
        """Find the nearest shape of every layer at every sample of some rows."""
        size = (len(self._layers), end - first, self.width)
        key = wp.full(size, wp.int64(NOTHING), dtype=wp.int64, device=self.device)
        band = _BAND if self.device.is_cuda else end - first
        bands = -(-(end - first) // band)
        grid = self.grid(first, end)
        for layer, (start, stop) in enumerate(self._layers):
            if stop > start:
                wp.launch(
                    cover_triangles,
                    (stop - start, bands),
                    [self.corner[start:stop], start, grid, band],
                    [key[layer]],
                    device=self.device,
                )
        if len(self.center):
            wp.launch(
                cover_balls,
                (len(self.center), bands),
                [self.center, self.radius, len(self.corner), grid, band],
                [key[0]],
                device=self.device,
            )
        return key

    def _array(self, value: ndarray, dtype: Any) -> Any:
        return wp.array(np.ascontiguousarray(value), dtype=dtype, device=self.device)
