"""First guess of how a hand lies: where its palm is, from triangulated keypoints or one view."""

from collections.abc import Sequence as Many
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation, Slerp

from physhandi.data.camera import PinholeCamera, triangulate
from physhandi.errors import FitError
from physhandi.fitting.checks.readiness import LEAST_PALM_POINTS, PALM
from physhandi.fitting.hands.observed import DepthTarget
from physhandi.hand.model import HandModel

_PALM_BONES = ((0, 5), (0, 9), (0, 13), (0, 17), (5, 17))
"""Pairs of palm keypoints whose distances give the scale."""
_LEAST_POINTS = 8
"""Measured points that tell how far away a hand is."""
_BESIDE = 0.01
"""Distance at which a line of sight still meets a vertex [m]."""
_STEADY = 0.3
"""Time over which the median of the way to the measured depth is taken [s]."""


WristPose = tuple[Rotation, Float[ndarray, " 3"]]
"""Rotation and position of the wrist [m]."""


@dataclass(frozen=True)
class WristGuess:
    """First guess of the wrist's pose in every frame."""

    rotation: Float[ndarray, "frame 4"]
    """Unit quaternion (x, y, z, w) of the hand; its sign is continuous over frames."""
    translation: Float[ndarray, "frame 3"]
    """Position of the wrist [m, before scale]."""
    scale: float
    """Length units of the sequence per metre."""
    is_known: Bool[ndarray, " frame"]
    """Frames that show the palm; in the others the pose is interpolated."""
    from_one_view: bool
    """Whether no frame's palm was triangulated: each pose is that of one view."""

    def pose(self, frame: int) -> WristPose:
        """Take out the pose of one frame."""
        return Rotation.from_quat(self.rotation[frame]), self.translation[frame]


def guess_wrist(
    cameras: Many[PinholeCamera],
    keypoint: Float[ndarray, "view frame 21 3"],
    model: HandModel,
    *,
    metric: bool,
    tolerance: float,
) -> WristGuess:
    """Align the template's palm with the triangulated palm; interpolate frames that lack one.

    Args:
        cameras: Camera of each view.
        keypoint: Pixel x, pixel y and confidence; NaN where not seen [px].
        model: Model of the hand.
        metric: Whether lengths are metres; otherwise the scale is estimated too.
        tolerance: Largest reprojection error at which views agree about a keypoint [px].

    Raises:
        FitError: If no frame shows enough of the palm.
    """
    template = template_keypoints(model)
    view_count, frame_count = keypoint.shape[:2]
    flat = keypoint.reshape(view_count, -1, 3)
    weight = np.nan_to_num(flat[..., 2])
    point = triangulate(cameras, flat[..., :2], weight, tolerance).reshape(frame_count, 21, 3)
    scale = 1.0 if metric else _scale(point, template)
    palm = list(PALM)
    rotation, translation = np.zeros((frame_count, 4)), np.zeros((frame_count, 3))
    is_known = np.zeros(frame_count, dtype=bool)
    for frame in range(frame_count):
        is_seen = np.isfinite(point[frame, palm]).all(-1)
        if is_seen.sum() >= LEAST_PALM_POINTS:
            pose = align(template[palm][is_seen], point[frame, palm][is_seen] / scale)
            rotation[frame], translation[frame] = pose[0].as_quat(), pose[1]
            is_known[frame] = True
    from_one_view = not is_known.any()
    if from_one_view:
        for frame in range(frame_count):
            pose = _guess_from_one_view(cameras, keypoint[:, frame, palm], template[palm] * scale)
            if pose is not None:
                rotation[frame], translation[frame] = pose[0].as_quat(), pose[1] / scale
                is_known[frame] = True
    if not is_known.any():
        raise FitError(
            f"The {model.side} hand cannot be placed: no frame shows "
            f"{LEAST_PALM_POINTS} keypoints of its palm apart from each other. Check the keypoints "
            "and the calibration."
        )
    rotation, translation = bridge(rotation, translation, is_known)
    return WristGuess(rotation, translation, scale, is_known, from_one_view)


def template_keypoints(model: HandModel) -> Float[ndarray, "21 3"]:
    """Pose the keypoints of a hand of mean shape at rest [m]."""
    zero = torch.zeros(1, 3, dtype=torch.float64)
    keypoint = model.keypoints(zero.new_zeros(10), zero.new_zeros(1, 15, 3), zero, zero)
    return keypoint[0].numpy()


def _scale(point: Float[ndarray, "frame 21 3"], template: Float[ndarray, "21 3"]) -> float:
    """Compare the palm's lengths, medians over frames, with the template's."""
    ratio = [
        np.linalg.norm(point[:, i] - point[:, j], axis=-1)
        / np.linalg.norm(template[i] - template[j])
        for i, j in _PALM_BONES
    ]
    ratios = np.array(ratio)
    return float(np.nanmedian(ratios)) if np.isfinite(ratios).any() else 1.0


def align(
    source: Float[ndarray, "point 3"], target: Float[ndarray, "point 3"]
) -> tuple[Rotation, Float[ndarray, " 3"]]:
    """Find the rigid motion that takes one set of points closest to another (Kabsch)."""
    covariance = (target - target.mean(0)).T @ (source - source.mean(0))
    left, _, right = np.linalg.svd(covariance)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = Rotation.from_matrix(left @ flip @ right)
    return rotation, target.mean(0) - rotation.apply(source.mean(0))


def _guess_from_one_view(
    cameras: Many[PinholeCamera],
    keypoint: Float[ndarray, "view point 3"],
    template: Float[ndarray, "point 3"],
) -> tuple[Rotation, Float[ndarray, " 3"]] | None:
    """Solve perspective-n-point in the view with the most confident palm keypoints."""
    is_seen, view = np.asarray(np.isfinite(keypoint).all(-1)), _clearest_view(keypoint)
    if is_seen[view].sum() < LEAST_PALM_POINTS or np.nansum(keypoint[view, :, 2]) <= 0:
        return None
    camera, indices = cameras[view], np.flatnonzero(is_seen[view, :])
    pixel = camera.undistort(keypoint[view, indices, :2].astype(np.float64))
    try:
        is_solved, vector, offset = cv2.solvePnP(
            template[indices], pixel, camera.K, None, flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:  # The keypoints are all in one place.
        return None
    if not is_solved:
        return None
    pose = camera.T_world_camera
    rotation = Rotation.from_matrix(pose[:3, :3]) * Rotation.from_rotvec(vector[:, 0])
    return rotation, pose[:3, :3] @ offset[:, 0] + pose[:3, 3]


def mirrored_pose(
    cameras: Many[PinholeCamera],
    keypoint: Float[ndarray, "view 21 3"],
    model: HandModel,
    pose: WristPose,
) -> WristPose:
    """Mirror a palm in depth: it is flat, so the view that sees it best shows it about as well."""
    palm = list(PALM)
    template, camera = template_keypoints(model)[palm], cameras[_clearest_view(keypoint[:, palm])]
    point = pose[0].apply(template) + pose[1]
    way = point.mean(axis=0) - camera.T_world_camera[:3, 3]
    way /= np.linalg.norm(way)
    along = (point - point.mean(axis=0)) @ way
    return align(template, point - 2 * along[:, None] * way)


def _clearest_view(keypoint: Float[ndarray, "view point 3"]) -> int:
    """Choose the view with the most confident keypoints, of those that show enough of them."""
    is_seen = np.asarray(np.isfinite(keypoint).all(-1))
    usable = np.where(is_seen.sum(1) >= LEAST_PALM_POINTS, np.nansum(keypoint[..., 2], 1), 0.0)
    return int(np.argmax(usable))


def bridge(
    rotation: Float[ndarray, "frame 4"],
    other: Float[ndarray, "frame number"],
    is_known: Bool[ndarray, " frame"],
) -> tuple[Float[ndarray, "frame 4"], Float[ndarray, "frame number"]]:
    """Interpolate unknown frames; before the first and after the last known one, hold the pose."""
    frame, known_frame = np.arange(len(is_known)), np.flatnonzero(is_known)
    if len(known_frame) > 1:
        between = np.clip(frame, known_frame[0], known_frame[-1])
        rotation = Slerp(known_frame, Rotation.from_quat(rotation[known_frame]))(between).as_quat()
    else:
        rotation = np.repeat(rotation[known_frame], len(frame), axis=0)
    for t in range(1, len(frame)):
        if rotation[t] @ rotation[t - 1] < 0:
            rotation[t] = -rotation[t]
    columns = [np.interp(frame, known_frame, column) for column in other[known_frame].T]
    return rotation, np.stack(columns, axis=1)


def way_to_depth(
    vertex: Float[ndarray, "frame vertex 3"],
    normal: Float[ndarray, "frame vertex 3"],
    target: DepthTarget,
    frame_rate: float,
) -> Float[ndarray, "frame 3"]:
    """Find how far each frame's hand lies from the depth that was measured of it [m].

    It is the median of `ways_to_depth` over a short time; frames without one are interpolated.
    """
    way = ways_to_depth(vertex, normal, target)
    measured = np.flatnonzero(np.isfinite(way[:, 0]))
    if not len(measured):
        return np.zeros((len(vertex), 3))
    window = min(len(measured), 2 * round(_STEADY * frame_rate / 2) + 1)
    steady = median_filter(way[measured], size=(window, 1), mode="nearest")
    frames = np.arange(len(vertex))
    return np.stack([np.interp(frames, measured, steady[:, axis]) for axis in range(3)], axis=1)


def ways_to_depth(
    vertex: Float[ndarray, "hand vertex 3"],
    normal: Float[ndarray, "hand vertex 3"],
    target: DepthTarget,
) -> Float[ndarray, "hand 3"]:
    """Find how far each hand lies from the depth that was measured of it [m].

    A point is compared with the vertex that its line of sight passes nearest to, of those that face
    the camera; how far the hand is off aside is left to the keypoints. NaN if too few points say
    it.
    """
    way = np.full((len(vertex), 3), np.nan)
    for hand in range(len(vertex)):
        count = int((target.weight[hand] > 0).sum())
        if count < _LEAST_POINTS:
            continue
        ray = target.towards_camera[hand, :count].numpy().astype(np.float64)
        point = target.point[hand, :count].numpy().astype(np.float64)
        place = vertex[hand].astype(np.float64)
        along = (point * ray).sum(axis=1)[:, None] - ray @ place.T
        squared = (point**2).sum(axis=1)[:, None] - 2 * point @ place.T + (place**2).sum(axis=1)
        aside = squared - along**2
        aside[ray @ normal[hand].T <= 0.0] = np.inf
        nearest = aside.argmin(axis=1)
        rows = np.arange(count)
        is_hit = aside[rows, nearest] < _BESIDE**2
        if is_hit.sum() < _LEAST_POINTS:
            continue
        direction = ray[is_hit].mean(axis=0)
        direction /= np.linalg.norm(direction)
        way[hand] = np.median(along[rows, nearest][is_hit]) * direction
    return way
