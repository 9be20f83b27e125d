"""How large hands are by keypoints and depth, which tells a wrong scale of depth.

A hand's size is known before anything is fitted: wherever a view has depth and keypoints of hands,
their palms measure the scale.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.observation import evenly
from physhandi.data.view import View

MEASURED_PALMS = "palm_length"
"""Provenance field of the palm lengths by view, by keypoints that are not stored [m]."""
PALM_LENGTH = 0.085
"""From wrist to knuckles of a hand between a child's and a large one [m]."""
PALM_LENGTHS = (0.06, 0.12)
"""Those of hands [m]."""
_MARGIN = 1.6
"""Factor by which keypoints and depth may err together."""
_WRIST, _KNUCKLES = 0, (5, 9, 13, 17)
_MOST_FRAMES = 24
_FEWEST = 8
"""Lengths that must be measured: those of two whole palms."""
_AROUND = 2
"""Pixels beside a keypoint whose depth counts [px]."""


def palm_length(view: View, keypoint: Float[ndarray, "frame hand 21 3"]) -> float | None:
    """Measure how long palms are, from wrist to knuckles: the median over frames and fingers.

    Keypoints whose depth is farther from the palm's median than the palm is wide see something
    else, before or behind it, and do not count; nor do hands that the camera sees edge-on.

    Args:
        view: View with depth.
        keypoint: Pixel x, pixel y and confidence; NaN where not seen [px].

    Returns:
        The length [m]; None if too little of hands was measured.
    """
    palm = keypoint[:, :, [_WRIST, *_KNUCKLES]].astype(np.float64)
    palm[~(np.isfinite(palm).all(axis=-1) & (palm[..., 2] > 0))] = np.nan
    is_shown = np.isfinite(palm[..., 0, 0]) & np.isfinite(palm[..., 1:, 0]).any(axis=-1)
    frames = np.flatnonzero(is_shown.any(axis=1))
    focal = float(np.sqrt(view.camera.K[0, 0] * view.camera.K[1, 1]))
    length: list[float] = []
    for frame in frames[evenly(len(frames), _MOST_FRAMES)]:
        depth = view.depth(int(frame))
        for hand in np.flatnonzero(is_shown[frame]):
            pixel = palm[frame, hand, :, :2]
            point = _lifted(view, pixel, _depth_at(depth, pixel), focal)
            length += np.linalg.norm(point[1:] - point[0], axis=1).tolist()
    measured = np.array(length)[np.isfinite(length)]
    return float(np.median(measured)) if len(measured) >= _FEWEST else None


def is_impossible_palm(length: float) -> bool:
    """Tell whether no hand has such a palm, even if keypoints and depth err.

    Args:
        length: What was measured [m].
    """
    return not PALM_LENGTHS[0] / _MARGIN <= length <= PALM_LENGTHS[1] * _MARGIN


def _depth_at(
    depth: Float[ndarray, "row column"], pixel: Float[ndarray, "point 2"]
) -> Float[ndarray, " point"]:
    """Take the median of what was measured around pixels; NaN where nothing was [m]."""
    medians = np.full(len(pixel), np.nan)
    for number in np.flatnonzero(np.isfinite(pixel).all(axis=1)):
        column, row = pixel[number].round().astype(int)
        if not (0 <= row < depth.shape[0] and 0 <= column < depth.shape[1]):
            continue
        around = depth[
            max(0, row - _AROUND) : row + _AROUND + 1,
            max(0, column - _AROUND) : column + _AROUND + 1,
        ]
        if (around > 0).any():
            medians[number] = np.median(around[around > 0])
    return medians


def _lifted(
    view: View,
    pixel: Float[ndarray, "point 2"],
    depth: Float[ndarray, " point"],
    focal: float,
) -> Float[ndarray, "point 3"]:
    """Lift a palm's keypoints into the world; NaN where they see something else [m]."""
    point = np.full((len(pixel), 3), np.nan)
    is_measured = np.isfinite(depth)
    if not is_measured.any():
        return point
    middle = np.median(depth[is_measured])
    apart = np.linalg.norm(pixel[is_measured, None] - pixel[None, is_measured], axis=-1).max()
    is_measured &= np.abs(np.nan_to_num(depth) - middle) <= apart * middle / focal
    point[is_measured] = view.camera.unproject(pixel[is_measured], depth[is_measured])
    return point
