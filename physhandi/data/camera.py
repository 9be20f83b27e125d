"""Calibrated pinhole cameras in OpenCV's conventions, and what several of them see."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.rotations import unit

_UNDISTORT_ITERATIONS = 30
_MIN_ANGLE = np.deg2rad(3)
_FIELDS = ("K", "T_world_camera", "width", "height", "distortion")


def _no_distortion() -> ndarray:
    return np.zeros(5)


@dataclass(frozen=True, eq=False)
class PinholeCamera:
    """The calibration of one view: intrinsics, lens distortion and pose.

    Camera axes are OpenCV's: x right, y down, z forward. A pixel's centre has integer coordinates.
    """

    K: Float[ndarray, "3 3"]
    """Intrinsic matrix [px]."""
    T_world_camera: Float[ndarray, "4 4"]
    """Maps camera coordinates to world coordinates [m]."""
    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""
    distortion: Float[ndarray, " 5"] = field(default_factory=_no_distortion)
    """Lens coefficients k1, k2, p1, p2, k3 of OpenCV's model."""

    def __post_init__(self) -> None:
        for name, shape in (("K", (3, 3)), ("T_world_camera", (4, 4)), ("distortion", (5,))):
            value = np.array(getattr(self, name), dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"{name} must be {shape} finite numbers, not {value.tolist()}")
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        if self.width < 1 or self.height < 1:
            raise ValueError(f"width and height must be positive, not {self.width}x{self.height}")
        if self.K[0, 0] <= 0 or self.K[1, 1] <= 0 or not np.array_equal(self.K[2], [0, 0, 1]):
            raise ValueError(
                f"K must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]], not {self.K.tolist()}"
            )
        rotation = self.T_world_camera[:3, :3]
        is_small = np.abs(rotation).max() < 2.0  # The product of larger ones may have no number.
        is_rotation = is_small and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
        if not is_rotation or np.linalg.det(rotation) < 0:
            raise ValueError("T_world_camera must hold a rotation (orthonormal, determinant +1)")
        if not np.allclose(self.T_world_camera[3], [0, 0, 0, 1]):
            raise ValueError("T_world_camera must end in the row [0, 0, 0, 1]")

    @property
    def T_camera_world(self) -> Float[ndarray, "4 4"]:
        """Maps world coordinates to camera coordinates [m]."""
        rotation = self.T_world_camera[:3, :3].T
        inverse = np.eye(4)
        inverse[:3, :3] = rotation
        inverse[:3, 3] = -rotation @ self.T_world_camera[:3, 3]
        return inverse

    def to_camera(self, point: Float[ndarray, "*batch 3"]) -> Float[ndarray, "*batch 3"]:
        """Express world points in camera coordinates [m]."""
        transform = self.T_camera_world
        return point @ transform[:3, :3].T + transform[:3, 3]

    def camera_depth(self, point: Float[ndarray, "*batch 3"]) -> Float[ndarray, "*batch"]:
        """Measure how far world points lie in front of the camera, along its z axis [m]."""
        return self.to_camera(point)[..., 2]

    def project(self, point: Float[ndarray, "*batch 3"]) -> Float[ndarray, "*batch 2"]:
        """Find the pixels where world points are seen, lens distortion included.

        Args:
            point: Points in the world frame [m].

        Returns:
            Pixel x and y [px], also outside the image; NaN for points that are not in front.
        """
        local = self.to_camera(point)
        depth = np.where(local[..., 2:] > 0, local[..., 2:], np.nan)
        ray = self._distort(local[..., :2] / depth)
        return ray @ self.K[:2, :2].T + self.K[:2, 2]

    def undistort(self, pixel: Float[ndarray, "*batch 2"]) -> Float[ndarray, "*batch 2"]:
        """Move pixels to where a lens without distortion would have seen them [px]."""
        return self._ray(pixel) @ self.K[:2, :2].T + self.K[:2, 2]

    def distort(self, pixel: Float[ndarray, "*batch 2"]) -> Float[ndarray, "*batch 2"]:
        """Move pixels from there to where the camera recorded them [px]; the way back."""
        ray = (pixel - self.K[:2, 2]) @ np.linalg.inv(self.K[:2, :2]).T
        return self._distort(ray) @ self.K[:2, :2].T + self.K[:2, 2]

    def unproject(
        self, pixel: Float[ndarray, "*batch 2"], depth: Float[ndarray, "*batch"]
    ) -> Float[ndarray, "*batch 3"]:
        """Find the world points that pixels see at given depths.

        Args:
            pixel: Pixel x and y, as the camera recorded them [px].
            depth: Distance along the camera's z axis [m].

        Returns:
            Points in the world frame [m].
        """
        ray = self._ray(pixel)
        local = np.concatenate([ray, np.ones_like(ray[..., :1])], axis=-1) * depth[..., None]
        return local @ self.T_world_camera[:3, :3].T + self.T_world_camera[:3, 3]

    def to_dict(self) -> dict[str, Any]:
        """Describe the camera in plain lists and numbers, as ``sequence.yaml`` holds it."""
        return {
            "K": self.K.tolist(),
            "T_world_camera": self.T_world_camera.tolist(),
            "width": self.width,
            "height": self.height,
            "distortion": self.distortion.tolist(),
        }

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> "PinholeCamera":
        """Build a camera from what `to_dict` returned.

        Raises:
            ValueError: If a field is missing, unknown or makes no sense; names the field.
        """
        unknown = sorted(set(fields) - set(_FIELDS), key=str)
        if unknown:
            raise ValueError(f"unknown field {unknown[0]!r} (known: {', '.join(_FIELDS)})")
        missing = [name for name in _FIELDS[:4] if name not in fields]
        if missing:
            raise ValueError(f"field {missing[0]!r} is missing")
        arrays: dict[str, ndarray] = {}
        for name in ("K", "T_world_camera", "distortion"):
            try:
                arrays[name] = np.array(fields.get(name, [0.0] * 5), dtype=np.float64)
            except (TypeError, ValueError, OverflowError):
                raise ValueError(f"{name} must hold numbers, not {fields[name]!r}") from None
        for name, shape in (("K", (3, 3)), ("T_world_camera", (4, 4)), ("distortion", (5,))):
            if arrays[name].shape != shape:
                raise ValueError(f"{name} must have shape {shape}, not {arrays[name].shape}")
        for name in ("width", "height"):
            if type(fields[name]) is not int:
                raise ValueError(f"{name} must be a whole number, not {fields[name]!r}")
        return cls(
            K=arrays["K"],
            T_world_camera=arrays["T_world_camera"],
            width=fields["width"],
            height=fields["height"],
            distortion=arrays["distortion"],
        )

    def _ray(self, pixel: ndarray) -> ndarray:
        """Turn recorded pixels into undistorted ray directions at depth one."""
        return self._undistort_ray((pixel - self.K[:2, 2]) @ np.linalg.inv(self.K[:2, :2]).T)

    def _distort(self, ray: ndarray) -> ndarray:
        k1, k2, p1, p2, k3 = self.distortion
        x, y = ray[..., 0], ray[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return np.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ],
            axis=-1,
        )

    def _undistort_ray(self, target: ndarray) -> ndarray:
        """Invert `_distort` by Newton's method."""
        if not self.distortion.any():
            return target
        k1, k2, p1, p2, k3 = self.distortion
        ray = np.array(target, dtype=np.float64)
        for _ in range(_UNDISTORT_ITERATIONS):
            error = self._distort(ray) - target
            if np.nanmax(np.abs(error), initial=0.0) < 1e-12:
                break
            x, y = ray[..., 0], ray[..., 1]
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = k1 + r2 * (2 * k2 + 3 * k3 * r2)
            xx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
            xy = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
            yy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
            determinant = xx * yy - xy * xy
            ray[..., 0] -= (yy * error[..., 0] - xy * error[..., 1]) / determinant
            ray[..., 1] -= (xx * error[..., 1] - xy * error[..., 0]) / determinant
        return ray


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
    rays = unit(np.stack([point - camera.T_world_camera[:3, 3] for camera in cameras]))
    widest = np.zeros(point.shape[0])
    for first in range(len(cameras)):
        for second in range(first):
            angle = np.arccos(np.clip((rays[first] * rays[second]).sum(-1), -1, 1))
            widest = np.where(is_seen[first] & is_seen[second], np.fmax(widest, angle), widest)
    return widest
