"""A first guess of the wrist in every frame, from which the fit of a hand starts."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.spatial.transform import Rotation, Slerp

from physhandi.data.camera import PinholeCamera
from physhandi.errors import FitError
from physhandi.fitting.triangulation import triangulate
from physhandi.hand.model import HandModel

PALM = (0, 1, 5, 9, 13, 17)
"""Keypoints that move with the palm."""
_PALM_BONES = ((0, 5), (0, 9), (0, 13), (0, 17), (5, 17))
_MIN_PALM_POINTS = 4


@dataclass(frozen=True)
class WristGuess:
    """Where the wrist is in every frame, roughly."""

    rotation: Float[ndarray, "frame 4"]
    """Unit quaternion (x, y, z, w) of the hand, without jumps of sign."""
    translation: Float[ndarray, "frame 3"]
    """Position of the wrist [m, before scale]."""
    scale: float
    """Length units of the sequence per metre."""


def guess_wrist(
    cameras: Sequence[PinholeCamera],
    keypoint: Float[ndarray, "view frame 21 3"],
    model: HandModel,
    *,
    metric: bool,
    tolerance: float,
) -> WristGuess:
    """Place the template's palm on the triangulated palm, and bridge the frames without one.

    Args:
        cameras: Camera of each view.
        keypoint: Pixel x, pixel y and confidence; NaN where not seen [px].
        model: The hand.
        metric: Whether lengths are metres; otherwise the scale is estimated too.
        tolerance: Largest error at which views agree about a keypoint [px].

    Raises:
        FitError: If no frame shows enough of the palm.
    """
    template = _template(model)
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
        if is_seen.sum() >= _MIN_PALM_POINTS:
            pose = _align(template[palm][is_seen], point[frame, palm][is_seen] / scale)
            rotation[frame], translation[frame] = pose[0].as_quat(), pose[1]
            is_known[frame] = True
    if not is_known.any():
        for frame in range(frame_count):
            pose = _guess_from_one_view(cameras, keypoint[:, frame, palm], template[palm] * scale)
            if pose is not None:
                rotation[frame], translation[frame] = pose[0].as_quat(), pose[1] / scale
                is_known[frame] = True
    if not is_known.any():
        raise FitError(
            f"The {model.side} hand cannot be placed: no frame shows "
            f"{_MIN_PALM_POINTS} keypoints of its palm apart from each other. Check the keypoints "
            "and the calibration."
        )
    rotation, translation = _bridge(rotation, translation, is_known)
    return WristGuess(rotation, translation, scale)


def _template(model: HandModel) -> Float[ndarray, "21 3"]:
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
    known = np.array(ratio)
    return float(np.nanmedian(known)) if np.isfinite(known).any() else 1.0


def _align(
    source: Float[ndarray, "point 3"], target: Float[ndarray, "point 3"]
) -> tuple[Rotation, Float[ndarray, " 3"]]:
    """Find the rigid motion that takes one set of points closest to another (Kabsch)."""
    covariance = (target - target.mean(0)).T @ (source - source.mean(0))
    left, _, right = np.linalg.svd(covariance)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = Rotation.from_matrix(left @ flip @ right)
    return rotation, target.mean(0) - rotation.apply(source.mean(0))


def _guess_from_one_view(
    cameras: Sequence[PinholeCamera],
    keypoint: Float[ndarray, "view point 3"],
    template: Float[ndarray, "point 3"],
) -> tuple[Rotation, Float[ndarray, " 3"]] | None:
    """Solve perspective-n-point in the view that is surest of the palm."""
    is_seen = np.asarray(np.isfinite(keypoint).all(-1))
    usable = np.where(is_seen.sum(1) >= _MIN_PALM_POINTS, np.nansum(keypoint[..., 2], 1), 0.0)
    view = int(np.argmax(usable))
    if usable[view] <= 0:
        return None
    camera, seen = cameras[view], np.flatnonzero(is_seen[view, :])
    pixel = camera.undistort(keypoint[view, seen, :2].astype(np.float64))
    try:
        found, vector, offset = cv2.solvePnP(
            template[seen], pixel, camera.K, None, flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:  # The keypoints are all in one place.
        return None
    if not found:
        return None
    pose = camera.T_world_camera
    rotation = Rotation.from_matrix(pose[:3, :3]) * Rotation.from_rotvec(vector[:, 0])
    return rotation, pose[:3, :3] @ offset[:, 0] + pose[:3, 3]


def _bridge(
    rotation: Float[ndarray, "frame 4"],
    translation: Float[ndarray, "frame 3"],
    is_known: Bool[ndarray, " frame"],
) -> tuple[Float[ndarray, "frame 4"], Float[ndarray, "frame 3"]]:
    """Interpolate over unknown frames; the first and last known pose are kept outside."""
    frame, known = np.arange(len(is_known)), np.flatnonzero(is_known)
    if len(known) > 1:
        between = np.clip(frame, known[0], known[-1])
        rotation = Slerp(known, Rotation.from_quat(rotation[known]))(between).as_quat()
    else:
        rotation = np.repeat(rotation[known], len(frame), axis=0)
    for t in range(1, len(frame)):
        if rotation[t] @ rotation[t - 1] < 0:
            rotation[t] = -rotation[t]
    columns = [np.interp(frame, known, translation[known, axis]) for axis in range(3)]
    return rotation, np.stack(columns, axis=1)
