"""How smooth a hand's motion is, as its keypoints tell.

A fit takes over a part of what the keypoints of each frame err by, and the hand trembles. How fast
it really moves is not known beforehand, so strengths of smoothing are chosen for each recording:
those with which the frames would best predict each other's keypoints (generalised
cross-validation, Craven and Wahba 1979; the smoother is Whittaker's, 1923). Fingers and wrist have
one each, since fingers that hold something move far more slowly than the wrist that carries it.
"""

import math
from collections.abc import Callable, Mapping
from functools import cache, partial

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.linalg import solveh_banded
from torch import Tensor

from physhandi.rotations import without_jumps

FINGERS, WRIST = 20, 6
"""Numbers by which a real hand is posed in a frame: angles of the fingers, and place and rotation
of the wrist."""
STRENGTHS = (0.0, *(10.0 ** np.arange(-2.0, 3.01, 0.25)).tolist())
"""Weights of squared second differences that are tried, beside those of what is smoothed."""


def smoothed(series: Float[ndarray, "frame ..."], strength: float) -> ndarray:
    """Give the series x with the least ``Σ (x - series)² + strength Σ (second differences of x)²``.

    What changes evenly stays, at the ends as well.
    """
    count = len(series)
    if count < 3 or strength <= 0.0:
        return np.array(series, np.float64)
    # The bands of 1 + strength DᵀD, where D takes second differences.
    band = np.zeros((3, count))
    band[2] = 1.0
    for offset, weight in enumerate((1.0, 4.0, 1.0)):
        band[2, offset : offset + count - 2] += strength * weight
    band[1, 1:-1] -= 2.0 * strength
    band[1, 2:] -= 2.0 * strength
    band[0, 2:] = strength
    flat = np.asarray(series, np.float64).reshape(count, -1)
    return solveh_banded(band, flat).reshape(series.shape)


def freedom_left(frame_count: int, strength: float) -> float:
    """Tell how many frames' worth of freedom smoothing leaves: the trace of the smoother."""
    frequency = np.pi * np.arange(frame_count) / frame_count
    return float((1.0 / (1.0 + strength * (2.0 * np.sin(frequency / 2.0)) ** 4)).sum())


def smoothed_pose(
    parameters: Mapping[str, Tensor], fingers: float, wrist: float
) -> dict[str, Tensor]:
    """Smooth the motion of a hand.

    Args:
        parameters: With ``articulation``, ``rotation`` (a quaternion) and ``translation``.
        fingers: Strength for the articulation.
        wrist: Strength for rotation and translation.

    Returns:
        These three, smoothed.
    """
    pose: dict[str, Tensor] = {}
    for name, strength in (("articulation", fingers), ("rotation", wrist), ("translation", wrist)):
        value = parameters[name].detach().double().numpy()
        if name == "rotation":
            value = without_jumps(value / np.linalg.norm(value, axis=-1, keepdims=True))
        value = smoothed(value, strength)
        if name == "rotation":
            value = value / np.linalg.norm(value, axis=-1, keepdims=True)
        pose[name] = torch.from_numpy(value.astype(np.float32))
    return pose


def best_strengths(
    error: Callable[[float, float], float], frame_count: int, coordinate_count: float
) -> tuple[float, float]:
    """Choose how much the motions of fingers and wrist are smoothed; 0 for not at all.

    The best one for both is chosen first, and then for each of them in turn, until none changes.

    Args:
        error: Computes the mean error of all keypoints, squared, of the motion whose fingers and
            wrist are smoothed with two strengths.
        frame_count: Frames of the motion.
        coordinate_count: Coordinates of keypoints that were seen, in all views and frames, of which
            one that is half trusted counts half.

    Returns:
        Strength for the fingers, and for the wrist.
    """
    freedom = cache(partial(freedom_left, frame_count))

    @cache
    def expected(strengths: tuple[float, float]) -> float:
        fingers, wrist = strengths
        numbers = FINGERS * freedom(fingers) + WRIST * freedom(wrist)
        left = 1.0 - numbers / max(coordinate_count, 1.0)
        # Keypoints may be too few to tell motion as free as this.
        return error(fingers, wrist) / left**2 if left > 0.0 else math.inf

    best, least = min(((both, both) for both in STRENGTHS), key=expected), math.inf
    while expected(best) < least:
        least = expected(best)
        best = min(((fingers, best[1]) for fingers in STRENGTHS), key=expected)
        best = min(((best[0], wrist) for wrist in STRENGTHS), key=expected)
    return best
