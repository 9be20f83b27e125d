"""Images without lens distortion: color of an ideal lens, and depth for its pixels."""

from typing import Any, cast

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from physhandi.data.importers.recorded_camera import FISHEYE, INVERSE, RecordedCamera

_cv2: Any = cv2
_FARTHEST = 65.535
"""Distances beyond this do not fit into 16 bits of millimetres [m]."""


class Rectifier:
    """Turns the images of one camera pair into those of an ideal color camera with the same K."""

    def __init__(
        self,
        grid: RecordedCamera,
        size: tuple[int, int],
        depth: RecordedCamera | None = None,
        depth_size: tuple[int, int] | None = None,
        T_color_depth: Float[ndarray, "4 4"] | None = None,
    ) -> None:
        """Prepare the maps of all pixels.

        Args:
            grid: The color camera, or the depth camera where there is no color.
            size: Width and height of its images [px].
            depth: The depth camera; None if depth is given for the pixels of `grid`.
            depth_size: Width and height of its images [px].
            T_color_depth: Maps its coordinates to the color camera's; None if both are one [m].
        """
        self.K = grid.K
        """Intrinsic matrix of the images that come out [px]."""
        self.size = size
        """Their width and height [px]."""
        self.is_changed = bool(len(grid.distortion))
        """Whether color images change at all."""
        self._map = _undistortion_map(grid, size) if self.is_changed else None
        self._ray: Float[ndarray, "pixel 3"] | None = None
        self._footprint = 1
        if depth is not None and depth_size is not None:
            ray = _rays(depth, depth_size)
            self._ray = np.concatenate([ray, np.ones((len(ray), 1))], axis=1)
            self._footprint = max(1, int(np.ceil(grid.K[0, 0] / depth.K[0, 0] - 1e-6)))
        self._T = np.eye(4) if T_color_depth is None else T_color_depth

    def color(self, image: UInt8[ndarray, "row column 3"]) -> UInt8[ndarray, "row column 3"]:
        """Straighten a color image."""
        if self._map is None:
            return image
        return cast("ndarray", cv2.remap(image, *self._map, cv2.INTER_LINEAR))

    def depth(self, image: Float[ndarray, "row column"]) -> Float[ndarray, "height width"]:
        """Move depth [m] to the pixels of the straightened color image; 0 where there is none.

        What is not finite, negative or beyond 65 m counts as none. Where several pixels meet, the
        nearest surface covers the others.
        """
        is_known = np.isfinite(image) & (image > 0) & (image < _FARTHEST)
        measured = np.where(is_known, image, 0.0).astype(np.float32)
        if self._ray is not None:
            return self._reprojected(measured)
        if self._map is None:
            return measured
        return cast("ndarray", cv2.remap(measured, *self._map, cv2.INTER_NEAREST))

    def _reprojected(self, depth: Float[ndarray, "row column"]) -> Float[ndarray, "height width"]:
        assert self._ray is not None  # noqa: S101 - its only caller has asked
        width, height = self.size
        flat = depth.ravel()
        point = self._ray[flat > 0] * flat[flat > 0, None].astype(np.float64)
        point = point @ self._T[:3, :3].T + self._T[:3, 3]
        point = point[point[:, 2] > 0]
        point = point[np.argsort(-point[:, 2], kind="stable")]  # The nearest is written last.
        pixel = (point[:, :2] / point[:, 2:]) @ self.K[:2, :2].T + self.K[:2, 2]
        out: Float[ndarray, "height width"] = np.zeros((height, width), np.float32)
        corner = np.floor(pixel - (self._footprint - 1) / 2 + 0.5).astype(np.int64)
        for row in range(self._footprint):
            for column in range(self._footprint):
                x, y = corner[:, 0] + column, corner[:, 1] + row
                is_inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
                x, y, z = x[is_inside], y[is_inside], point[is_inside, 2]
                layer: Float[ndarray, "height width"] = np.zeros_like(out)
                layer[y, x] = z
                is_nearer = (layer > 0) & ((out == 0) | (layer < out))
                out[is_nearer] = layer[is_nearer]
        return out


def _undistortion_map(camera: RecordedCamera, size: tuple[int, int]) -> tuple[ndarray, ndarray]:
    """Find for each pixel of the straight image the one of the recorded image that it shows."""
    K, coefficient = camera.K, camera.distortion
    if camera.model in FISHEYE:
        maps = _cv2.fisheye.initUndistortRectifyMap(
            K, coefficient[:4], np.eye(3), K, size, cv2.CV_32FC1
        )
    elif camera.model in INVERSE:
        # The polynomial leads to the straight ray, so the recorded one is found by iteration.
        ray = _cv2.undistortPoints(_pixels(size).reshape(-1, 1, 2), K, coefficient).reshape(-1, 2)
        pixel = (ray @ K[:2, :2].T + K[:2, 2]).reshape(size[1], size[0], 2).astype(np.float32)
        maps = pixel[..., 0], pixel[..., 1]
    else:
        maps = _cv2.initUndistortRectifyMap(K, coefficient, None, K, size, cv2.CV_32FC1)
    return np.ascontiguousarray(maps[0]), np.ascontiguousarray(maps[1])


def _rays(camera: RecordedCamera, size: tuple[int, int]) -> Float[ndarray, "pixel 2"]:
    """Find where each recorded pixel looks, at depth 1."""
    K, coefficient, pixel = camera.K, camera.distortion, _pixels(size)
    if not len(coefficient):
        return (pixel - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T
    points = pixel.reshape(-1, 1, 2)
    if camera.model in FISHEYE:
        return _cv2.fisheye.undistortPoints(points, K, coefficient[:4]).reshape(-1, 2)
    if camera.model in INVERSE:
        ray = np.concatenate(
            [(pixel - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T, np.ones((len(pixel), 1))], axis=1
        )
        return _cv2.projectPoints(ray, np.zeros(3), np.zeros(3), np.eye(3), coefficient)[0].reshape(
            -1, 2
        )
    return _cv2.undistortPoints(points, K, coefficient).reshape(-1, 2)


def _pixels(size: tuple[int, int]) -> Float[ndarray, "pixel 2"]:
    x, y = np.meshgrid(np.arange(size[0], dtype=np.float64), np.arange(size[1], dtype=np.float64))
    return np.stack([x.ravel(), y.ravel()], axis=1)
