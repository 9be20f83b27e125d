"""Draws splats: what they give every pixel of a picture, over a background and before occluders."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Float, Float32
from numpy import ndarray

from physhandi.appearance.kernels import (
    TILE_SIDE,
    Pinhole,
    Slopes,
    ask_splats,
    blend_splats,
    collect_in_splats,
    collect_in_tiles,
    find_lists,
    list_reached,
    project_splats,
    reach_tiles,
)
from physhandi.appearance.splats import Splats
from physhandi.data.camera import PinholeCamera
from physhandi.devices import start_warp

_PINHOLE: Any = Pinhole
_FLOAT: Any = wp.float32
_VEC3: Any = wp.vec3
_INT: Any = wp.int32
_LONG: Any = wp.int64
_BOX: Any = wp.vec4i
_VEC2: Any = wp.vec2
_SLOPES: Any = Slopes
PIXELS_OF_A_TILE = int(TILE_SIDE) ** 2
"""Pixels that share a list of splats, and threads of a block."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SplatImage:
    """A picture of splats."""

    color: Float32[ndarray, "row column 3"]
    """Red, green and blue of sRGB over the background, from 0 to 1."""
    alpha: Float32[ndarray, "row column"]
    """How much of what is behind they cover, from 0 to 1."""
    depth: Float32[ndarray, "row column"]
    """Mean depth of what covers, weighted by how much [m]; 0 where nothing does."""


def render_splats(
    camera: PinholeCamera,
    splats: Splats,
    *,
    center: Float[ndarray, "splat 3"] | None = None,
    background: Float[ndarray, "row column 3"] | None = None,
    occluder: Float[ndarray, "row column"] | None = None,
    device: str = "cpu",
) -> SplatImage:
    """Draw splats as a camera sees them. The same input gives the same bits on a device.

    Args:
        camera: Where the picture is taken from.
        splats: What is drawn.
        center: Where their middles are now, as `SplatBinding.carry` tells it [m]; at rest if left
            out.
        background: What is behind them, from 0 to 1; black if left out.
        occluder: Depth of other things; a splat that is farther away is not seen there [m]. 0 where
            nothing is.
        device: Warp device.

    Raises:
        ValueError: If the camera has distortion, or an array does not fit.
    """
    start_warp()
    place = splats.center if center is None else np.asarray(center, np.float32)
    if place.shape != splats.center.shape or not np.isfinite(place).all():
        raise ValueError(
            f"center has shape {place.shape} or values that are not finite; expected "
            f"{splats.center.shape}."
        )
    size = (camera.height, camera.width)
    for name, value, shape in (
        ("background", background, (*size, 3)),
        ("occluder", occluder, size),
    ):
        if value is not None and value.shape != shape:
            raise ValueError(f"{name} has shape {value.shape}; expected {shape}.")
    target: Any = wp.get_device(device)
    with wp.ScopedDevice(target):
        drawing = SplatDrawing(
            camera,
            center=_array(place, wp.vec3),
            scale=_array(splats.scale, wp.float32),
            color=_array(splats.color, wp.vec3),
            opacity=_array(splats.opacity, wp.float32),
            background=None if background is None else _array(background, wp.vec3),
            occluder=None if occluder is None else _array(occluder, wp.float32),
        )
        return SplatImage(
            color=drawing.color.numpy(), alpha=drawing.alpha.numpy(), depth=drawing.depth.numpy()
        )


class SplatDrawing:
    """A picture of splats on the current Warp device, with all that its slopes need.

    Attributes:
        center: Middles of the splats [m].
        tiles: Tiles of the picture.
        entries: Length of the lists of all tiles.
        color: Over the background, ``(row, column)``.
        alpha: What is covered.
        depth: Mean depth of what covers [m].
    """

    def __init__(
        self,
        camera: PinholeCamera,
        *,
        center: wp.array,
        scale: wp.array,
        color: wp.array,
        opacity: wp.array,
        background: wp.array | None = None,
        occluder: wp.array | None = None,
    ) -> None:
        """Draw.

        Args:
            camera: Where the picture is taken from.
            center: Middles of the splats [m].
            scale: Their standard deviations [m].
            color: Their colors.
            opacity: Their opacities.
            background: Color behind them; black if left out.
            occluder: Depth of other things, 0 where nothing is [m]; nothing if left out.

        Raises:
            ValueError: If the camera has distortion.
        """
        size = (camera.height, camera.width)
        self._pinhole = _pinhole_of(camera)
        self._columns = -(-camera.width // int(TILE_SIDE))
        self._rows = -(-camera.height // int(TILE_SIDE))
        self.tiles = self._columns * self._rows
        self.center, self._scale = center, scale
        self._splat_color, self._opacity = color, opacity
        self._background = wp.zeros(size, dtype=wp.vec3) if background is None else background
        self._occluder = wp.zeros(size, dtype=wp.float32) if occluder is None else occluder
        self._project()
        self._list()
        # What kernels are given of tiles, and of the splats in the picture.
        self._lists = self._columns, self._begin, self._end, self._listed
        self._seen = self._middle, self._conic, self._away, self._splat_color, self._opacity
        self.color: Any = wp.empty(size, dtype=_VEC3)
        self.alpha: Any = wp.empty(size, dtype=_FLOAT)
        self.depth: Any = wp.empty(size, dtype=_FLOAT)
        wp.launch(
            blend_splats,
            (self.tiles, PIXELS_OF_A_TILE),
            [*self._lists, *self._seen, self._background, self._occluder],
            [self.color, self.alpha, self.depth],
            block_dim=PIXELS_OF_A_TILE,
        )

    def slopes(
        self, color: wp.array, alpha: wp.array, depth: wp.array
    ) -> tuple[wp.array, wp.array, wp.array, wp.array]:
        """Carry the slopes of a loss back from the picture to the splats.

        Args:
            color: How it changes with the color of each pixel.
            alpha: With what is covered.
            depth: With the mean depth of what covers [1/m].

        Returns:
            How it changes with the splats' middles [1/m], standard deviations [1/m], colors and
            opacities.
        """
        share = wp.empty((self.entries, PIXELS_OF_A_TILE), dtype=_VEC2)
        wp.launch(
            ask_splats,
            (self.tiles, PIXELS_OF_A_TILE),
            [
                *(*self._lists, *self._seen, self._background, self._occluder),
                *(self.alpha, self.depth, self.color, color, alpha, depth),
            ],
            [share],
            block_dim=PIXELS_OF_A_TILE,
        )
        listed = wp.empty(self.entries, dtype=_SLOPES)
        wp.launch(
            collect_in_tiles,
            self.entries,
            [
                *(self._columns, self._listed, self._key, self._middle, self._conic),
                *(self.alpha, color, depth, share),
            ],
            [listed],
            block_dim=PIXELS_OF_A_TILE,
        )
        count = len(self.center)
        seen = [wp.empty(count, dtype=kind) for kind in (_VEC2, _VEC3, _FLOAT)]
        tint, opacity = wp.empty(count, dtype=_VEC3), wp.empty(count, dtype=_FLOAT)
        wp.launch(
            collect_in_splats,
            count,
            [self._first, self._reached, self._place, self._opacity, listed],
            [*seen, tint, opacity],
        )
        center, scale = wp.zeros(count, dtype=wp.vec3), wp.zeros(count, dtype=wp.float32)
        wp.launch(
            project_splats,
            count,
            [self._pinhole, self.center, self._scale],
            [self._middle, self._conic, self._away],
            adj_inputs=[_PINHOLE(), center, scale],
            adj_outputs=seen,
            adjoint=True,
        )
        return center, scale, tint, opacity

    def _project(self) -> None:
        count = len(self.center)
        self._middle = wp.zeros(count, dtype=wp.vec2)
        self._conic = wp.zeros(count, dtype=wp.vec3)
        self._away = wp.zeros(count, dtype=wp.float32)
        wp.launch(
            project_splats,
            count,
            [self._pinhole, self.center, self._scale],
            [self._middle, self._conic, self._away],
        )

    def _list(self) -> None:
        """List the splats that reach into each tile, the nearest first."""
        count = len(self.center)
        box = wp.empty(count, dtype=_BOX)
        self._reached = wp.empty(count, dtype=_INT)
        wp.launch(
            reach_tiles,
            count,
            [self._middle, self._conic, self._away, self._opacity, self._columns, self._rows],
            [box, self._reached],
        )
        end = wp.empty(count, dtype=_INT)
        wp.utils.array_scan(self._reached, end, inclusive=True)
        self.entries = int(end[-1:].numpy()[0]) if count else 0
        self._first = wp.empty(count, dtype=_INT)
        wp.utils.array_scan(self._reached, self._first, inclusive=False)
        # Sorting takes twice the room.
        self._key: Any = wp.empty(2 * self.entries, dtype=_LONG)
        slot = wp.empty(2 * self.entries, dtype=_INT)
        splat = wp.empty(self.entries, dtype=_INT)
        wp.launch(
            list_reached,
            count,
            [box, self._away, self._first, self._columns],
            [self._key, slot, splat],
        )
        wp.utils.radix_sort_pairs(
            self._key, slot, self.entries, end_bit=32 + self.tiles.bit_length()
        )
        self._listed = wp.empty(self.entries, dtype=_INT)
        self._place = wp.empty(self.entries, dtype=_INT)
        self._begin = wp.zeros(self.tiles, dtype=wp.int32)
        self._end = wp.zeros(self.tiles, dtype=wp.int32)
        wp.launch(
            find_lists,
            self.entries,
            [self.entries, self._key, slot, splat],
            [self._listed, self._place, self._begin, self._end],
        )


def _pinhole_of(camera: PinholeCamera) -> Any:
    """Describe a camera to kernels.

    Raises:
        ValueError: If it has distortion.
    """
    if camera.distortion.any():
        raise ValueError("the camera must have no lens distortion; undistort what it recorded")
    pinhole = _PINHOLE()
    pinhole.rotation = wp.mat33(*camera.T_camera_world[:3, :3].ravel())
    pinhole.translation = wp.vec3(*camera.T_camera_world[:3, 3])
    pinhole.focal = wp.vec3(camera.K[0, 0], camera.K[0, 1], camera.K[1, 1])
    pinhole.middle = wp.vec2(*camera.K[:2, 2])
    pinhole.size = wp.vec2i(camera.width, camera.height)
    return pinhole


def _array(value: ndarray, dtype: Any) -> Any:
    return wp.array(np.ascontiguousarray(value, np.float32), dtype=dtype)
