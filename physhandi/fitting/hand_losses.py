"""What a fitted hand is asked for: seen where it was seen, possible, and moving smoothly."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from physhandi.data.camera import PinholeCamera
from physhandi.hand.model import HandModel

_KNUCKLE = ((-1.7, 0.6), (-0.4, 0.4), (-0.25, 0.25))
_MIDDLE = ((-2.0, 0.2), (-0.08, 0.08), (-0.08, 0.08))
_LAST = ((-1.5, 0.4), (-0.08, 0.08), (-0.08, 0.08))
_THUMB = (
    ((-0.9, 0.9), (-0.9, 0.9), (-0.6, 0.6)),
    ((-1.2, 0.6), (-0.4, 0.4), (-0.3, 0.3)),
    ((-1.6, 0.6), (-0.15, 0.15), (-0.15, 0.15)),
)
JOINT_LIMIT = np.array([*_THUMB, *([_KNUCKLE, _MIDDLE, _LAST] * 4)])
"""Lower and upper bound of each joint's rotation vector, for a right hand [rad]."""


@dataclass(frozen=True)
class KeypointTarget:
    """Keypoints of one hand in all views, with the lens distortion taken out."""

    pixel: Float[Tensor, "view frame 21 2"]
    """Where the keypoints were seen; zero where they were not [px]."""
    weight: Float[Tensor, "view frame 21"]
    """Confidence; zero where a keypoint was not seen."""
    noise: Float[Tensor, " view"]
    """Error to be expected of a keypoint in each view [px]."""
    projection: Float[Tensor, "view 3 4"]
    """Maps homogeneous world points to pixels without lens distortion."""


def keypoint_target(
    cameras: Sequence[PinholeCamera],
    keypoint: Float[ndarray, "view frame 21 3"],
    relative_noise: float,
) -> KeypointTarget:
    """Prepare keypoints for `reprojection_loss`.

    Args:
        cameras: Camera of each view.
        keypoint: Pixel x, pixel y and confidence; NaN where not seen [px].
        relative_noise: Expected error as a share of the hand's size in the image.
    """
    is_seen = np.isfinite(keypoint).all(-1) & (keypoint[..., 2] > 0)
    filled = np.where(is_seen[..., None], keypoint, 0.0).astype(np.float64)
    pixel = np.stack([c.undistort(k[..., :2]) for c, k in zip(cameras, filled, strict=True)])
    projection = np.stack([camera.K @ camera.T_camera_world[:3] for camera in cameras])
    noise = np.maximum(relative_noise * np.array([_hand_size(view) for view in keypoint]), 0.5)
    return KeypointTarget(
        pixel=torch.tensor(pixel, dtype=torch.float32),
        weight=torch.tensor(filled[..., 2] * is_seen, dtype=torch.float32),
        noise=torch.tensor(noise, dtype=torch.float32),
        projection=torch.tensor(projection, dtype=torch.float32),
    )


def _hand_size(keypoint: Float[ndarray, "frame 21 3"]) -> float:
    """Measure how large a hand usually is in a view: the diagonal of its keypoints' box [px]."""
    is_whole = np.isfinite(keypoint).all(-1).sum(1) >= 15
    if not is_whole.any():
        return 100.0
    pixel = keypoint[is_whole, :, :2]
    diagonal = np.linalg.norm(np.nanmax(pixel, 1) - np.nanmin(pixel, 1), axis=-1)
    return float(np.median(diagonal))


def reprojection_loss(
    point: Float[Tensor, "frame 21 3"], target: KeypointTarget, breadth: float
) -> Float[Tensor, ""]:
    """Compare projected keypoints with seen ones, a frame's sum averaged over frames.

    Cauchy's robust loss ``c² log(1 + (r / c)²)`` of the distance ``r`` in units of the expected
    noise: an observation that is wrong by many ``c`` no longer pulls.

    Args:
        point: Keypoints in the world frame.
        target: What was seen.
        breadth: ``c``, the distance in units of noise beyond which an observation is doubted.
    """
    frame_count = point.shape[0]
    homogeneous = torch.cat([point, torch.ones_like(point[..., :1])], -1)
    seen = torch.einsum("vij,fkj->vfki", target.projection, homogeneous)
    depth = seen[..., 2:]
    nearest = 1e-3 * depth.detach().abs().median()
    pixel = seen[..., :2] / depth.clamp(min=float(nearest) + 1e-9)
    squared = ((pixel - target.pixel) ** 2).sum(-1) / target.noise[:, None, None] ** 2
    robust = breadth**2 * torch.log1p(squared / breadth**2)
    return (target.weight * robust).sum() / frame_count


def limit_loss(articulation: Float[Tensor, "frame 15 3"], model: HandModel) -> Float[Tensor, ""]:
    """Sum the squares of what the joints turn beyond their limits, averaged over frames [rad²]."""
    mirror = torch.tensor([1.0, -1.0, -1.0] if model.side == "left" else [1.0, 1.0, 1.0])
    limit = torch.tensor(JOINT_LIMIT, dtype=articulation.dtype)
    turned = articulation * mirror
    beyond = (limit[..., 0] - turned).relu() + (turned - limit[..., 1]).relu()
    return (beyond**2).sum() / articulation.shape[0]


def acceleration_loss(point: Float[Tensor, "frame 21 3"]) -> Float[Tensor, ""]:
    """Sum the squared second differences of the keypoints over time, averaged over frames."""
    if point.shape[0] < 3:
        return point.sum() * 0
    second = point[2:] - 2 * point[1:-1] + point[:-2]
    return (second**2).sum() / point.shape[0]


def velocity_loss(point: Float[Tensor, "frame joint 3"]) -> Float[Tensor, ""]:
    """Sum the squared differences from frame to frame, averaged over frames."""
    return ((point[1:] - point[:-1]) ** 2).sum() / point.shape[0]
