"""Points in space from the pixels at which calibrated views see them."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.camera import PinholeCamera

_MIN_ANGLE = np.deg2rad(3)


def triangulate(
    cameras: Sequence[PinholeCamera],
    pixel: Float[ndarray, "view point 2"],
    weight: Float[ndarray, "view point"],
    tolerance: float,
) -> Float[ndarray, "point 3"]:
    """Triangulate points by the direct linear transform, keeping only those that all views confirm.

    Args:
        cameras: Camera of each view.
        pixel: Where each view sees each point; NaN where it does not [px].
        weight: Trust in each observation.
        tolerance: Largest distance between an observation and the point's projection [px].

    Returns:
        World points; NaN where fewer than two views see the point, where they see it along nearly
        the same ray, or where one of them disagrees.
    """
    point = np.full((pixel.shape[1], 3), np.nan)
    if len(cameras) < 2:
        return point
    is_seen = np.isfinite(pixel).all(-1) & (weight > 0)
    rows = np.zeros((pixel.shape[1], 2 * len(cameras), 4))
    for view, camera in enumerate(cameras):
        projection = camera.K @ camera.T_camera_world[:3]
        straight = camera.undistort(np.where(is_seen[view][:, None], pixel[view], 0.0))
        equation = straight[:, :, None] * projection[2] - projection[:2]
        trust = np.where(is_seen[view], weight[view], 0.0)[:, None, None]
        scale = np.linalg.norm(projection[0, :3])
        rows[:, 2 * view : 2 * view + 2] = trust * equation / scale
    enough = is_seen.sum(0) >= 2
    if not enough.any():
        return point
    solution = np.linalg.svd(rows[enough])[2][:, -1]
    homogeneous = np.where(abs(solution[:, 3:]) > 1e-12, solution[:, 3:], np.nan)
    point[enough] = solution[:, :3] / homogeneous
    is_confirmed = _widest_angle(cameras, point, is_seen) > _MIN_ANGLE
    for view, camera in enumerate(cameras):
        error = np.linalg.norm(camera.project(point) - pixel[view], axis=-1)
        is_confirmed &= ~is_seen[view] | (error <= tolerance)
    point[~is_confirmed] = np.nan
    return point


def _widest_angle(
    cameras: Sequence[PinholeCamera],
    point: Float[ndarray, "point 3"],
    is_seen: ndarray,
) -> Float[ndarray, " point"]:
    """Compute the largest angle between the rays on which a point is seen [rad]."""
    rays = np.stack([point - camera.T_world_camera[:3, 3] for camera in cameras])
    rays /= np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-12)
    widest = np.zeros(point.shape[0])
    for first in range(len(cameras)):
        for second in range(first):
            angle = np.arccos(np.clip((rays[first] * rays[second]).sum(-1), -1, 1))
            widest = np.where(is_seen[first] & is_seen[second], np.fmax(widest, angle), widest)
    return widest
