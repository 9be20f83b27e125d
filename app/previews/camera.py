"""Camera of a drawn preview."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.camera import PinholeCamera

_AZIMUTH = float(np.deg2rad(-61.0))
_ELEVATION = float(np.deg2rad(26.0))
_DISTANCE = 2.6
_MARGIN = 0.07
_OUTLIERS = 0.002


def fitting_camera(point: Float[ndarray, "point 3"], width: int, height: int) -> PinholeCamera:
    """Look at points from where the viewer looks at first, so that they fill the picture.

    Args:
        point: Finite points of all frames, z up; at least one.
        width: Width of the picture [px].
        height: Height of the picture [px].
    """
    low, high = np.quantile(point, [_OUTLIERS, 1 - _OUTLIERS], axis=0)
    center, extent = (low + high) / 2, max(float(np.linalg.norm(high - low)), 1e-6)
    flat = np.array([np.cos(_AZIMUTH), np.sin(_AZIMUTH), 0.0])
    back = np.cos(_ELEVATION) * flat + np.sin(_ELEVATION) * np.array([0.0, 0.0, 1.0])
    right = np.array([-np.sin(_AZIMUTH), np.cos(_AZIMUTH), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(-back, right), -back], axis=1)
    pose[:3, 3] = center + _DISTANCE * extent * back
    local = (point - pose[:3, 3]) @ pose[:3, :3]
    near, far = np.quantile(
        local[:, :2] / np.maximum(local[:, 2:], 0.1 * extent), [_OUTLIERS, 1 - _OUTLIERS], axis=0
    )
    size = np.array([width, height], dtype=float)
    least = 1e-3  # A single point is not enlarged without end.
    focal = float(((1 - 2 * _MARGIN) * size / np.maximum(far - near, least)).min())
    middle = size / 2 - focal * (near + far) / 2
    K = np.array([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]])
    return PinholeCamera(K=K, T_world_camera=pose, width=width, height=height)
