"""Color scales that are read as numbers: even steps of a value look like even steps of color."""

from functools import cache
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from physhandi.srgb import to_srgb

Scale = Literal["sequential", "diverging"]
"""Whether a value counts from one end, or away from zero in both directions."""

UNKNOWN = (128, 133, 140)
"""Color of what has no value."""
_STEPS = 256
_TRIM = (0.06, 0.96)
"""Part of viridis that is seen on a black and on a white background."""
_BELOW, _ZERO, _ABOVE = (0.50, -0.035, -0.15), (0.66, 0.0, 0.0), (0.55, 0.18, 0.09)
"""Ends and middle of the diverging scale in Oklab: blue, gray, red."""
_TO_CONE = np.array(
    [
        [1, 0.3963377774, 0.2158037573],
        [1, -0.1055613458, -0.0638541728],
        [1, -0.0894841775, -1.291485548],
    ]
)
_TO_LINEAR = np.array(
    [
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.707614701],
    ]
)


def paint_values(
    value: Float[ndarray, "*item"],
    limits: tuple[float, float],
    scale: Scale = "sequential",
    *,
    is_logarithmic: bool = False,
) -> UInt8[ndarray, "*item 3"]:
    """Give every value its color; those outside the limits get the color of the nearer end.

    Args:
        value: What is told; NaN is painted as `UNKNOWN`.
        limits: Values at both ends.
        scale: Which colors.
        is_logarithmic: Whether equal ratios, instead of differences, are equal steps.
    """
    return paint_levels(levels(value, limits, is_logarithmic=is_logarithmic), scale)


def paint_levels(level: Float[ndarray, "*item"], scale: Scale) -> UInt8[ndarray, "*item 3"]:
    """Give places on a scale, from 0 to 1, their colors; NaN gets `UNKNOWN`."""
    index = np.nan_to_num(level * (_STEPS - 1)).round().astype(np.int64)
    color = table(scale)[index]
    color[np.isnan(level)] = UNKNOWN
    return color


def levels(
    value: Float[ndarray, "*item"], limits: tuple[float, float], *, is_logarithmic: bool = False
) -> Float[ndarray, "*item"]:
    """Tell where on the scale values lie, from 0 to 1; NaN stays NaN."""
    low, high = limits
    value = np.asarray(value, dtype=np.float64)
    if is_logarithmic and low > 0:
        value, low, high = np.log(np.maximum(value, 1e-300)), np.log(low), np.log(max(high, low))
    if high <= low:
        return np.where(np.isnan(value), np.nan, np.where(value > high, 1.0, 0.0))
    return np.clip((value - low) / (high - low), 0.0, 1.0)


@cache
def table(scale: Scale) -> UInt8[ndarray, "step 3"]:
    """List the colors of a scale from its low to its high end."""
    place = np.linspace(0.0, 1.0, _STEPS)
    if scale == "sequential":
        index = np.round((_TRIM[0] + place * (_TRIM[1] - _TRIM[0])) * 255).astype(np.uint8)
        return cv2.applyColorMap(index[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1].copy()
    stops = np.array([_BELOW, _ZERO, _ABOVE])
    lab = np.stack([np.interp(place, [0.0, 0.5, 1.0], stops[:, i]) for i in range(3)], axis=1)
    linear = np.clip((lab @ _TO_CONE.T) ** 3 @ _TO_LINEAR.T, 0.0, 1.0)
    return np.round(255 * to_srgb(linear)).astype(np.uint8)
