"""How smooth a hand's motion is, as its keypoints tell.

A fit takes over a part of what the keypoints of each frame err by, and the hand trembles. How fast
it really moves is not known beforehand, so a strength of smoothing is chosen for each recording:
the one with which the frames would best predict each other's keypoints (generalised
cross-validation, Craven and Wahba 1979; the smoother is Whittaker's, 1923).
"""

from collections.abc import Callable, Mapping

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.linalg import solveh_banded
from torch import Tensor

from physhandi.rotations import without_jumps

FREEDOM = 26
"""Numbers by which a real hand is posed in a frame: 20 angles of fingers, 6 of the wrist."""
STRENGTHS = 10.0 ** np.arange(-2.0, 3.01, 0.25)
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


def smoothed_pose(parameters: Mapping[str, Tensor], strength: float) -> dict[str, Tensor]:
    """Smooth ``articulation``, ``rotation`` (a quaternion) and ``translation`` of a hand."""
    pose: dict[str, Tensor] = {}
    for name in ("articulation", "rotation", "translation"):
        value = parameters[name].detach().double().numpy()
        if name == "rotation":
            value = without_jumps(value / np.linalg.norm(value, axis=-1, keepdims=True))
        value = smoothed(value, strength)
        if name == "rotation":
            value = value / np.linalg.norm(value, axis=-1, keepdims=True)
        pose[name] = torch.from_numpy(value.astype(np.float32))
    return pose


def best_strength(
    error: Callable[[float], float], frame_count: int, coordinate_count: float
) -> float:
    """Choose how much a hand's motion is smoothed; 0 for not at all.

    Args:
        error: Computes the mean error of all keypoints, squared, of the motion that is smoothed
            with a strength.
        frame_count: Frames of the motion.
        coordinate_count: Coordinates of keypoints that were seen, in all views and frames, of which
            one that is half trusted counts half.
    """
    best, least = 0.0, np.inf
    for strength in (0.0, *STRENGTHS.tolist()):
        left = 1.0 - FREEDOM * freedom_left(frame_count, strength) / max(coordinate_count, 1.0)
        if left <= 0.0:  # Keypoints are too few to tell motion as free as this.
            continue
        expected = error(strength) / left**2
        if expected < least:
            best, least = strength, expected
    return best
