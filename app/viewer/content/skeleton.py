"""Hand keypoints of several views, lifted to the world for a first look."""

from collections.abc import Sequence as Listing

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.view import View

BONES = np.array(
    [
        *([0, 1], [1, 2], [2, 3], [3, 4]),
        *([0, 5], [5, 6], [6, 7], [7, 8]),
        *([5, 9], [9, 10], [10, 11], [11, 12]),
        *([9, 13], [13, 14], [14, 15], [15, 16]),
        *([13, 17], [0, 17], [17, 18], [18, 19], [19, 20]),
    ]
)
"""Pairs of keypoints, in MediaPipe's order, that a bone joins."""

_MIN_CONFIDENCE = 0.3


def lift_keypoints(views: Listing[View]) -> tuple[Float[ndarray, "frame keypoint 3"], ...]:
    """Triangulate each hand's keypoints from all views that see them.

    Args:
        views: Views; those without keypoints are left out.

    Returns:
        One array per hand [m], NaN where fewer than two views see a keypoint; empty if fewer than
        two views have keypoints.
    """
    seen = [(view, view.keypoint) for view in views if view.keypoint is not None]
    if len(seen) < 2:
        return ()
    gram = np.zeros((*seen[0][1].shape[:3], 4, 4))
    count = np.zeros(seen[0][1].shape[:3], dtype=int)
    for view, keypoint in seen:
        is_seen = np.isfinite(keypoint[..., :2]).all(-1) & (keypoint[..., 2] >= _MIN_CONFIDENCE)
        pixel = np.where(is_seen[..., None], keypoint[..., :2], 0.0).astype(np.float64)
        ray = view.camera.undistort(pixel) - view.camera.K[:2, 2]
        y = ray[..., 1] / view.camera.K[1, 1]
        x = (ray[..., 0] - view.camera.K[0, 1] * y) / view.camera.K[0, 0]
        row_x, row_y, row_z, _ = view.camera.T_camera_world
        rows = np.stack([x[..., None] * row_z - row_x, y[..., None] * row_z - row_y], axis=-2)
        gram += np.einsum("...ri,...rj->...ij", rows, rows) * is_seen[..., None, None]
        count += is_seen
    _, vectors = np.linalg.eigh(gram)
    solution = vectors[..., 0]
    weight = np.where(np.abs(solution[..., 3:]) > 1e-9, solution[..., 3:], np.nan)
    point = np.where((count >= 2)[..., None], solution[..., :3] / weight, np.nan)
    return tuple(point[:, hand].astype(np.float32) for hand in range(point.shape[1]))
