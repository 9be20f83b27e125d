"""Observation of one hand: keypoints, measured points, and empty space."""

from collections.abc import Sequence as Many
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor

from physhandi.data.camera import PinholeCamera
from physhandi.data.observation import evenly
from physhandi.data.sequence import Sequence
from physhandi.data.view import View
from physhandi.hand.names import HandSide
from physhandi.perception.lifting import HAND_LABEL, pixel_values, surface_points
from physhandi.perception.segmentation import draw_hand

_GRID = 64
"""Rows and columns in which depth around a hand is kept."""
_MARGIN = 0.25
"""How far this reaches beyond the hand's keypoints, as a share of their extent."""
_HALF_HAND = 0.07
"""Distance of a hand's pixels from their median, along the view [m]."""
_FEWEST = 3
"""Keypoints that tell where in the image a hand is."""


@dataclass(frozen=True)
class KeypointTarget:
    """Undistorted keypoints of one hand in all views."""

    pixel: Float[Tensor, "view frame 21 2"]
    """Position in the image; zero where not seen [px]."""
    weight: Float[Tensor, "view frame 21"]
    """Confidence; zero where not seen."""
    noise: Float[Tensor, " view"]
    """Expected keypoint error of each view [px]."""
    projection: Float[Tensor, "view 3 4"]
    """Maps homogeneous world points to pixels without lens distortion."""


@dataclass(frozen=True)
class FreeSpace:
    """Depth around one hand: between a camera and what it measured there is nothing.

    All pixels are those of a lens without distortion.
    """

    depth: Float[Tensor, "view frame row column"]
    """Depth of what is seen there; zero where nothing was measured [m]."""
    corner: Float[Tensor, "view frame 2"]
    """Pixel of the first row and column [px]."""
    step: Float[Tensor, "view frame"]
    """Pixels from one row to the next [px]."""
    projection: Float[Tensor, "view 3 4"]
    """Maps homogeneous world points to pixels and their depth."""


@dataclass(eq=False)
class DepthTarget:
    """Measured surface points of one hand, and the vertices they correspond to."""

    point: Float[Tensor, "frame point 3"]
    """Measured points; zero where a frame has fewer [m]."""
    towards_camera: Float[Tensor, "frame point 3"]
    """Unit vector from each point to the camera that measured it."""
    weight: Float[Tensor, "frame point"]
    """One over the frame's number of points; zero on padding."""
    vertex: Tensor | None = None
    """Vertex that each point corresponds to; None before the first evaluation."""
    normal: Float[Tensor, "frame point 3"] | None = None
    """Normal of the surface there when `vertex` was found, if normals are held fixed."""
    age: int = 0
    """Evaluations since `vertex` was last updated."""


def keypoint_target(
    cameras: Many[PinholeCamera],
    keypoint: Float[ndarray, "view frame 21 3"],
    relative_noise: float,
) -> KeypointTarget:
    """Undistort keypoints for `reprojection_loss`.

    Args:
        cameras: Camera of each view.
        keypoint: Pixel x, pixel y and confidence; NaN where not seen [px].
        relative_noise: Expected error as a share of the hand's size in the image.
    """
    is_seen = np.isfinite(keypoint).all(-1) & (keypoint[..., 2] > 0)
    filled = np.where(is_seen[..., None], keypoint, 0.0).astype(np.float64)
    pixel = np.stack([c.undistort(k[..., :2]) for c, k in zip(cameras, filled, strict=True)])
    projection = np.stack([camera.K @ camera.T_camera_world[:3] for camera in cameras])
    noise = np.maximum(relative_noise * np.array([hand_size(view) for view in keypoint]), 0.5)
    return KeypointTarget(
        pixel=torch.tensor(pixel, dtype=torch.float32),
        weight=torch.tensor(filled[..., 2] * is_seen, dtype=torch.float32),
        noise=torch.tensor(noise, dtype=torch.float32),
        projection=torch.tensor(projection, dtype=torch.float32),
    )


def hand_size(keypoint: Float[ndarray, "frame 21 3"]) -> float:
    """Compute the median diagonal of the keypoints' bounding box in one view [px]."""
    is_whole = np.isfinite(keypoint).all(-1).sum(1) >= 15
    if not is_whole.any():
        return 100.0
    pixel = keypoint[is_whole, :, :2]
    diagonal = np.linalg.norm(np.nanmax(pixel, 1) - np.nanmin(pixel, 1), axis=-1)
    return float(np.median(diagonal))


def depth_target(
    sequence: Sequence,
    side: HandSide,
    point_count: int,
    keypoint: Float[ndarray, "view frame 21 3"] | None = None,
) -> DepthTarget | None:
    """Collect one hand's depth points of all views, at most `point_count` a frame.

    Args:
        sequence: The recording.
        side: Which hand.
        point_count: Most points of a frame.
        keypoint: Keypoints of this hand, around which it is looked for in views without masks.

    Returns:
        The points; None if no view has depth and either masks or keypoints of this hand.
    """
    numbers = [
        number
        for number, view in enumerate(sequence.views)
        if view.has_depth and (view.has_mask or keypoint is not None)
    ]
    frames = []
    for frame in range(sequence.frame_count):
        point, camera = np.zeros((0, 3)), np.zeros((0, 3))
        for number in numbers:
            view = sequence.views[number]
            depth = view.depth(frame)
            if view.has_mask:
                is_hand = view.mask(frame) == HAND_LABEL[side]
            else:
                assert keypoint is not None  # noqa: S101 - numbers hold no such view otherwise
                is_hand = _at_keypoints(keypoint[number, frame, :, :2], depth)
            measured = surface_points(view, depth, is_hand)
            point = np.concatenate([point, measured])
            camera = np.concatenate([camera, view.camera.T_world_camera[:3, 3] - measured])
        chosen = evenly(len(point), point_count)
        frames.append((point[chosen], camera[chosen]))
    if not any(len(point) for point, _ in frames):
        return None
    shape = (len(frames), point_count, 3)
    point, ray, weight = np.zeros(shape), np.zeros(shape), np.zeros(shape[:2])
    for frame, (measured, camera) in enumerate(frames):
        count = len(measured)
        if count:
            point[frame, :count] = measured
            ray[frame, :count] = camera / np.linalg.norm(camera, axis=1, keepdims=True)
            weight[frame, :count] = 1 / count
    return DepthTarget(
        point=torch.tensor(point, dtype=torch.float32),
        towards_camera=torch.tensor(ray, dtype=torch.float32),
        weight=torch.tensor(weight, dtype=torch.float32),
    )


def _at_keypoints(
    keypoint: Float[ndarray, "21 2"], depth: Float[ndarray, "row column"]
) -> Bool[ndarray, "row column"]:
    """Choose the pixels on bones and palm of a hand, without what is far before or behind it.

    Things that hide the hand are before it, and what shows between fingers is behind: half of the
    pixels must be the hand's.
    """
    core = draw_hand(keypoint, depth.shape)
    if core is None:
        return np.zeros(depth.shape, dtype=bool)
    measured = (core > 0) & (depth > 0)
    if not measured.any():
        return measured
    return measured & (np.abs(depth - np.median(depth[measured])) < _HALF_HAND)


def free_space(views: Many[View], target: KeypointTarget) -> FreeSpace:
    """Read how far each view with depth saw around the keypoints of one hand.

    Args:
        views: Views of the sequence.
        target: Their keypoints.
    """
    view_count, frame_count = target.weight.shape[:2]
    depth = np.zeros((view_count, frame_count, _GRID, _GRID), np.float32)
    corner, step = np.zeros((view_count, frame_count, 2)), np.ones((view_count, frame_count))
    for number, view in enumerate(views):
        for frame in range(frame_count if view.has_depth else 0):
            seen = target.pixel[number, frame][target.weight[number, frame] > 0].numpy()
            if len(seen) < _FEWEST:
                continue
            low, extent = seen.min(axis=0), max(float(np.ptp(seen, axis=0).max()), 1.0)
            corner[number, frame] = low - _MARGIN * extent
            step[number, frame] = (1 + 2 * _MARGIN) * extent / (_GRID - 1)
            at = np.stack(np.meshgrid(np.arange(_GRID), np.arange(_GRID)), axis=-1)
            pixel = corner[number, frame] + step[number, frame] * at
            depth[number, frame] = pixel_values(view.depth(frame), view.camera.distort(pixel))
    return FreeSpace(
        depth=torch.tensor(depth),
        corner=torch.tensor(corner, dtype=torch.float32),
        step=torch.tensor(step, dtype=torch.float32),
        projection=target.projection,
    )
